"""Tests the replay page in headless Chromium, opened from a file and without a network."""

import base64
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import chromium
import numpy as np
import pytest
import replays
import steering
from PIL import Image

from swarmjax import policy_file
from swarmjax.replay import pack as replay_pack
from swarmjax.replay import page as replay_page
from swarmjax.replay.episodes import outcome
from swarmjax.replay.record import Recording, ReplayEpisode

pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from swarmjax.replay.config import ReplayConfig
from swarmjax.task.stage_files import load_levels

pytestmark = chromium.needed
HOSTILE = "</script><script>document.title='in'</script>.npz"
WORDS = (*replays.SMALL, "level=0,3", "steps=120")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from chromium.browsers(tmp_path_factory.mktemp("profile"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[list[Recording]]:
    """Records two levels, each with a policy that steers and one that drives straight ahead."""
    folder = tmp_path_factory.mktemp("policies")
    steer = steering.write(folder / "steer.npz")
    ahead = steering.write(folder / "ahead.npz", steering.AHEAD)
    by_policy = [replays.recorded(path, *WORDS)[1] for path in (steer, ahead)]
    return [list(each) for each in zip(*by_policy, strict=True)]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory, runs: list[list[Recording]]) -> Path:
    """Writes the page of both levels and both policies."""
    folder = tmp_path_factory.mktemp("page")
    settings = load_levels(ReplayConfig, [f"policy={HOSTILE},ahead.npz", *WORDS])
    trained = policy_file.read(steering.write(folder / "steer.npz"))
    episodes = [
        ReplayEpisode(f"Episode {level} of s6: {outcome(each, settings.task)}", level, each)
        for each, level in zip(runs, settings.levels, strict=True)
    ]
    path = folder / "replay.html"
    path.write_text(replay_page.page(settings, [trained] * 2, episodes, "the command"))
    return path


def _open(
    browser: Any,
    file: Path,
    width: int = 1200,
    height: int = 900,
    *,
    still: bool = True,
    dark: bool = False,
) -> None:
    """Opens the page; with `still` the browser asks for reduced motion, so nothing plays."""
    wishes = {
        "prefers-reduced-motion": "reduce" if still else "no-preference",
        "prefers-color-scheme": "dark" if dark else "light",
    }
    features = [{"name": name, "value": value} for name, value in wishes.items()]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    for log in ("performance", "browser"):
        browser.get_log(log)  # reading empties it
    browser.get(file.as_uri())
    WebDriverWait(browser, 20).until(lambda _: _js(browser, "!!window.replay?.ready"))


def _js(browser: Any, expression: str, *arguments: Any) -> Any:
    return browser.execute_script(f"return {expression}", *arguments)


def _shade(browser: Any, kind: str, number: int = 0) -> int:
    """Returns how many colours a canvas shows."""
    script = """
      const canvas = document.querySelectorAll(arguments[0])[arguments[1]];
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return new Set(new Uint32Array(data.buffer)).size;
    """
    return browser.execute_script(script, kind, number)


def test_it_opens_from_a_file_and_asks_for_nothing_else(browser, file):
    _open(browser, file)
    _js(browser, "replay.play()")
    _js(browser, "replay.open(1)")
    seen = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = {
        each["params"]["request"]["url"]
        for each in seen
        if each["method"] == "Network.requestWillBeSent"
    }
    # The icon is empty and inside the page.
    assert asked - {"data:,"} == {file.as_uri()}
    assert _js(browser, "performance.getEntriesByType('resource').map((each) => each.name)") == []
    assert browser.get_log("browser") == []  # no errors, no violations of the page's policy


def test_it_plays_at_once(browser, file):
    _open(browser, file, still=False)
    assert _js(browser, "replay.playing")
    assert _js(browser, "document.getElementById('play').textContent") == "Pause"
    WebDriverWait(browser, 20).until(lambda _: _js(browser, "replay.frame") > 0)


def test_it_waits_where_less_motion_is_asked_for(browser, file):
    _open(browser, file)
    assert not _js(browser, "replay.playing")
    assert _js(browser, "replay.frame") == 0


def test_positions_are_those_that_were_recorded(browser, file, runs):
    _open(browser, file)
    assert _js(browser, "replay.episodes") == 2
    for number, both in enumerate(runs):
        _js(browser, "replay.open(arguments[0])", number)
        frames = max(len(run.pose) for run in both)
        assert _js(browser, "replay.frames") == frames
        for frame in (0, frames // 2, frames - 1):
            _js(browser, "replay.seek(arguments[0])", frame)
            assert _js(browser, "replay.frame") == frame
            for i, run in enumerate(both):
                row = min(frame, len(run.pose) - 1)
                found = np.array(_js(browser, "replay.positions(undefined, arguments[0])", i))
                error = np.abs(found - run.pose[row])
                # The page rounds to 0.2 mm and 1 mrad, so errors are at most half of that, plus
                # float64 rounding.
                assert error[:, :2].max() <= 1e-4 + 1e-9
                assert error[:, 2].max() <= 5e-4 + 1e-9
                _check_numbers(browser, run, frame, row, i)


def _check_numbers(browser: Any, run: Recording, frame: int, row: int, i: int) -> None:
    """Compares the page's distances, rewards and rays with the recording."""
    where = (frame, i)
    distance = _js(browser, "replay.distances(...arguments)", *where)
    # Along each axis the position is off by at most half of 0.2 mm, and the target by 5 um.
    np.testing.assert_allclose(distance, run.distance[row], atol=1.05e-4 * 2**0.5)
    reward = sum(term[: row + 1].sum(axis=0) for term in run.reward.values())
    # The page rounds each term to 1e-4, so a term is off by at most half of that, plus float64
    # rounding.
    found = _js(browser, "replay.rewards(...arguments)", *where)
    np.testing.assert_allclose(found, reward, atol=0.5e-4 * len(run.reward) + 1e-9)
    rays = np.array(_js(browser, "replay.rays(...arguments)", *where), float)  # null: nan
    lit = run.ray[row] < 0.04
    np.testing.assert_array_equal(~np.isnan(rays), lit)
    assert (np.abs(rays - run.ray[row])[lit] <= 2.5e-4 + 1e-9).all()


def test_robots_are_drawn_where_they_are(browser, file, runs):
    _open(browser, file)
    (run, _), frame = runs[0], 40
    _js(browser, "replay.seek(arguments[0])", frame)
    canvas = browser.find_element("css selector", ".arena").size
    # 22 px are reserved for the scale, and 12 mm of wall are shown on every side.
    scale = min(canvas["width"], canvas["height"] - 22) / (run.scene.side + 2 * 0.012)
    for colour, (x, y, yaw) in zip(replay_pack.colours(3), run.pose[frame], strict=True):
        # This point is behind the robot's centre, away from its number and its arrow.
        x, y = x - 0.022 * np.cos(yaw), y - 0.022 * np.sin(yaw)
        pixel = (canvas["width"] / 2 + scale * x, (canvas["height"] - 22) / 2 - scale * y)
        script = """
          const context = document.querySelector(".arena").getContext("2d");
          return [...context.getImageData(arguments[0], arguments[1], 1, 1).data];
        """
        found = browser.execute_script(script, *map(round, pixel))
        assert found == [*bytes.fromhex(colour[1:]), 255]


def test_it_plays_to_the_last_frame(browser, file):
    _open(browser, file)
    _js(browser, "document.getElementById('speed').value = 16")
    assert not _js(browser, "replay.playing")
    _js(browser, "document.getElementById('play').click()")
    assert _js(browser, "replay.playing")
    WebDriverWait(browser, 20).until(lambda _: not _js(browser, "replay.playing"))
    assert _js(browser, "replay.frame") == _js(browser, "replay.frames") - 1
    last = _js(browser, "replay.frames") - 1
    assert _js(browser, "document.getElementById('clock').textContent") == (
        f"{last * 0.032:.2f} of {last * 0.032:.2f} s, step {last} of {last}"
    )


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Writes a page of 400 steps, 12.8 s, which is longer than the trails of 10 s."""
    folder = tmp_path_factory.mktemp("long")
    settings = load_levels(ReplayConfig, ["policy=a.npz"])
    trained = policy_file.read(steering.write(folder / "steer.npz"))
    episodes = [replays.episode(replays.wandering(1, 401))]
    path = folder / "replay.html"
    path.write_text(replay_page.page(settings, [trained], episodes, "the command"))
    return path


def test_a_trail_is_drawn_beyond_its_ten_seconds(browser, long):
    _open(browser, long)
    script = """
      const line = CanvasRenderingContext2D.prototype.lineTo;
      let bad = 0, longest = 0, now = 0;
      const begin = CanvasRenderingContext2D.prototype.beginPath;
      CanvasRenderingContext2D.prototype.beginPath = function () { now = 0; begin.call(this); };
      CanvasRenderingContext2D.prototype.lineTo = function (x, y) {
        if (Number.isFinite(x) && Number.isFinite(y)) longest = Math.max(longest, ++now);
        else bad++;
        line.call(this, x, y);
      };
      const trails = document.getElementById("trails");
      trails.selectedIndex = 1; // 10 s
      replay.seek(400); // the chart's layer, whose curves are as long as the episode, is there
      [bad, longest] = [0, 0];
      trails.dispatchEvent(new Event("change"));
      CanvasRenderingContext2D.prototype.lineTo = line;
      CanvasRenderingContext2D.prototype.beginPath = begin;
      return [bad, longest];
    """
    # 10 s are 312.5 steps, which JavaScript rounds to 313. A line of 313 steps has 314 points.
    assert browser.execute_script(script) == [0, 314]


def test_the_numbers_are_those_of_the_picture_once_it_pauses(browser, long):
    _open(browser, long)
    # The page updates the numbers at most once in 100 ms. This script pauses at a frame for which
    # the page has not updated the numbers yet.
    script = """
      const done = arguments[0];
      const clock = document.getElementById("clock");
      document.getElementById("speed").value = 16;
      replay.play();
      const wait = () => {
        const read = Number(clock.textContent.match(/step (\\d+)/)[1]);
        if (replay.frame > 0 && replay.frame !== read) {
          replay.pause();
          done([replay.frame, Number(clock.textContent.match(/step (\\d+)/)[1])]);
        } else if (replay.playing) requestAnimationFrame(wait);
        else done(null);
      };
      requestAnimationFrame(wait);
    """
    frame, read = browser.execute_async_script(script)
    assert frame == read


def test_it_is_played_by_keyboard(browser, file):
    _open(browser, file)

    def press(*keys: str) -> None:
        ActionChains(browser).send_keys(*keys).perform()

    press(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    assert _js(browser, "replay.frame") == 2
    press(Keys.END)
    assert _js(browser, "replay.frame") == _js(browser, "replay.frames") - 1
    press(Keys.HOME)
    assert _js(browser, "replay.frame") == 0
    press("+", "+", "-")
    assert _js(browser, "replay.speed") == 2
    press("n")
    assert _js(browser, "[replay.episode, replay.level]") == [1, 3]
    press("p")
    assert _js(browser, "[replay.episode, replay.level]") == [0, 0]
    press(Keys.SPACE)
    assert _js(browser, "replay.playing")
    press(Keys.SPACE)
    assert not _js(browser, "replay.playing")
    # The space bar presses a focused button instead of starting the replay.
    browser.execute_script("document.getElementById('forth').focus()")
    frame = _js(browser, "replay.frame")
    press(Keys.SPACE)
    assert _js(browser, "[replay.frame, replay.playing]") == [frame + 1, False]


def test_a_drag_on_a_chart_goes_to_that_time(browser, file):
    _open(browser, file)
    chart = browser.find_element("css selector", ".chart")
    width = chart.size["width"]
    # The plot has margins of 50 px on the left and 14 px on the right. Offsets are measured from
    # the middle of the chart.
    middle = 50 + (width - 64) / 2 - width / 2
    drag = ActionChains(browser).move_to_element_with_offset(chart, round(middle) - 60, 0)
    drag.click_and_hold().move_by_offset(60, 0).release().perform()
    last = _js(browser, "replay.frames") - 1
    pixel = last / (width - 64)
    assert abs(_js(browser, "replay.frame") - last / 2) <= 1 + pixel  # rounded to a pixel


def test_a_hostile_name_is_shown_as_it_is(browser, file):
    _open(browser, file)
    names = _js(browser, "[...document.querySelectorAll('h2')].map((each) => each.textContent)")
    assert names == [HOSTILE, "ahead.npz"]
    assert _js(browser, "document.scripts.length") == 2


@pytest.mark.parametrize(("width", "dark"), [(400, False), (1600, False), (900, True)])
def test_it_fits_and_is_drawn(browser, file, width, dark):
    _open(browser, file, width, dark=dark)
    _js(browser, "replay.seek(60)")
    assert _js(browser, "document.documentElement.scrollWidth") <= width
    for number in range(2):
        # Robots, targets, walls, boxes and their edges have many colours. An empty canvas has one
        # colour.
        assert _shade(browser, ".arena", number) > 20
        assert _shade(browser, ".chart", number) > 20
    left = [_js(browser, f"document.querySelectorAll('.run')[{i}].offsetLeft") for i in range(2)]
    assert (left[0] == left[1]) == (width < 760)  # stacked or side by side
    card = _js(browser, "getComputedStyle(document.body).backgroundColor")
    assert card == ("rgb(20, 21, 23)" if dark else "rgb(251, 251, 250)")


def test_the_title_is_that_of_the_open_episode(browser, file):
    _open(browser, file)
    _js(browser, "replay.open(1)")
    assert browser.title == "Episode 3 of s6: 1 and 0 of 3 robots arrived, 3.8 and 3.8 s"
    assert _js(browser, "document.querySelector('h1').textContent") == browser.title


def test_the_path_of_the_policy_is_shown_once(browser, file):
    _open(browser, file)
    browser.execute_script("document.querySelector('details').open = true")
    assert _js(browser, "document.body.innerText").count(HOSTILE) == 1


def test_walls_that_meet_leave_no_line_between_them(browser, runs, tmp_path):
    path, names = tmp_path / "replay.html", ["policy=a.npz"]
    trained = policy_file.read(steering.write(tmp_path / "steer.npz"))
    # Edges that meet in the middle of a pixel or anywhere else in it, straight and turned.
    yaw, half = 0.3, [0.0313, 0.1]
    boxes = [
        [0.0626 * i * np.cos(yaw) - 0.3, 0.0626 * i * np.sin(yaw), yaw, *half] for i in range(8)
    ] + [[0.0626 * i - 0.2, -0.4, 0.0, *half] for i in range(8)]
    scene = replace(runs[0][0].scene, box=np.array(boxes), side=1.2)
    episodes = [replays.episode(replace(replays.wandering(1, 3), scene=scene))]
    settings = load_levels(ReplayConfig, names)
    path.write_text(replay_page.page(settings, [trained], episodes, "the command"))
    _open(browser, path)
    script = """
      const canvas = document.querySelector(".arena");
      const scale = Math.min(canvas.clientWidth, canvas.clientHeight - 22) / (1.2 + 0.024);
      const place = (x, y) => [canvas.clientWidth / 2 + scale * x,
        (canvas.clientHeight - 22) / 2 - scale * y];
      const context = canvas.getContext("2d");
      const seen = new Set();
      for (let along = 0; along < 0.43; along += 0.0005) {
        const [cos, sin] = [Math.cos(0.3), Math.sin(0.3)];
        for (const [x, y] of [[along - 0.2, -0.45], [along * cos - 0.3, along * sin]]) {
          seen.add(context.getImageData(...place(x, y).map(Math.floor), 1, 1).data.join());
        }
      }
      return [...seen];
    """
    assert browser.execute_script(script) == ["185,189,196,255"]  # --box


def test_full_screen_shows_the_arenas_and_the_controls_alone(browser, file):
    _open(browser, file)
    button = browser.find_element("css selector", "#full")
    button.click()
    WebDriverWait(browser, 20).until(lambda _: button.text == "Leave full screen")
    assert _js(browser, "document.fullscreenElement.id") == "content"
    assert [browser.find_element("css selector", each).is_displayed() for each in _PARTS] == [
        True,
        True,
        False,
        False,
    ]
    _js(browser, "replay.seek(60)")
    assert _shade(browser, ".arena", 1) > 20  # drawn, although no chart is laid out
    ActionChains(browser).send_keys("f").perform()
    WebDriverWait(browser, 20).until(lambda _: button.text == "Full screen")
    assert browser.find_element("css selector", ".chart").is_displayed()


_PARTS = ("#controls", ".arena", ".chart", "#key")


def _gif(browser: Any) -> Any:
    """Returns the film of the open episode."""
    script = """
      const done = arguments[0];
      replay.gif().then((gif) => {
        const reader = new FileReader();
        reader.onload = () => done(reader.result.split(",")[1]);
        reader.readAsDataURL(gif);
      }, (error) => done(String(error)));
    """
    return Image.open(io.BytesIO(base64.b64decode(browser.execute_async_script(script))))


def _differing(browser: Any, film: Any) -> float:
    """Returns the share of pixels of a film's last picture that differ from the arena's."""
    film.seek(film.n_frames - 1)
    shown = np.asarray(film.convert("RGB"), int)[:480, :480]
    script = """
      const canvas = document.querySelector(".arena");
      const card = document.createElement("canvas");
      [card.width, card.height] = [480, 502];
      const context = card.getContext("2d");
      context.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--card");
      context.fillRect(0, 0, 480, 502);
      context.drawImage(canvas, 0, 0);
      return [...context.getImageData(0, 0, 480, 480).data];
    """
    drawn = np.array(browser.execute_script(script)).reshape(480, 480, 4)[..., :3]
    return (np.abs(shown - drawn).max(axis=-1) > 24).mean()


def test_a_gif_ends_with_the_picture_that_the_page_ends_with(browser, file):
    _open(browser, file)
    browser.set_script_timeout(120)
    film = _gif(browser)
    assert film.size == (960, 502)  # two policies
    _js(browser, "replay.seek(replay.frames - 1)")
    # The page's arena takes the size of the film's.
    browser.execute_script(
        "const arena = document.querySelector('.arena'); arena.style.cssText ="
        "'width: 480px; height: 502px; aspect-ratio: auto; max-height: none';"
    )
    WebDriverWait(browser, 20).until(
        lambda _: _js(browser, "document.querySelector('.arena').width") == 480
    )
    assert _differing(browser, film) < 0.002


def test_a_gif_plays_at_the_speed_of_the_page(browser, file):
    _open(browser, file)
    _js(browser, "document.getElementById('speed').value = 2")
    last = _js(browser, "replay.frames") - 1
    # At twice the speed 12.5 pictures a second are 5 control steps of 0.032 s apart.
    assert _gif(browser).n_frames == 1 + -(-last // 5)


def test_a_gif_is_saved_under_the_level_it_shows(browser, file, tmp_path):
    _open(browser, file)
    where = {"behavior": "allow", "downloadPath": str(tmp_path)}
    browser.execute_cdp_cmd("Page.setDownloadBehavior", where)
    _js(browser, "replay.open(1)")
    _js(browser, "document.getElementById('speed').value = 16")
    browser.find_element("css selector", "#gif").click()
    WebDriverWait(browser, 30).until(lambda _: [*tmp_path.glob("*.gif")])
    assert [each.name for each in tmp_path.iterdir()] == ["episode-3.gif"]


def test_everything_to_be_pressed_has_a_name(browser, file):
    _open(browser, file)
    script = """
      const inputs = [...document.querySelectorAll("button, select, input, canvas")];
      return inputs.filter((each) => !(each.getAttribute("aria-label") ?? each.textContent.trim())
        && !each.labels?.length).map((each) => each.outerHTML);
    """
    assert browser.execute_script(script) == []


def test_a_robot_is_singled_out(browser, file, runs):
    _open(browser, file)
    browser.find_element("css selector", ".robots li:nth-child(2) button").click()
    last = len(runs[0][0].pose) - 1
    _js(browser, "replay.seek(arguments[0])", last)
    details = _js(browser, "[...document.querySelectorAll('.detail')].map((p) => p.textContent)")
    distance = runs[0][0].distance[last, 1]
    assert details[0].startswith("Robot 2: ")
    # The page shows three decimals, in m, of a distance that is off by at most 0.15 mm.
    assert float(details[0].split()[2]) == pytest.approx(distance, abs=7e-4)
    pressed = "document.querySelectorAll('[aria-pressed=true]').length"
    assert _js(browser, pressed) == 2  # in both views
    browser.find_element("css selector", ".robots li:nth-child(2) button").click()
    assert _js(browser, pressed) == 0
