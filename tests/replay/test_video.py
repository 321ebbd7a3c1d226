"""Tests the replay's video: its camera, its pictures and its file."""

import math
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import replays

from swarmjax.config import ConfigError
from swarmjax.replay import video
from swarmjax.replay.config import ReplayConfig
from swarmjax.task.stage_files import load_levels

ROOT = Path(video.__file__).resolve().parents[2]


def _settings(*words: str) -> ReplayConfig:
    return load_levels(ReplayConfig, ["policy=a", *words])


def test_the_camera_has_all_of_the_arena_in_its_picture():
    for side, aspect in ((1.2, 16 / 9), (4.0, 4 / 3), (0.5, 0.5)):
        away = video.camera_distance(side, aspect)
        tall = wide = 0.0
        for x in (-1, 1):
            for y in (-1, 1):
                for z in (0.0, 0.1):  # The height of the walls.
                    # 30 mm of wall are shown. The camera looks along y, 58 degrees down.
                    px, py = x * (side / 2 + 0.03), y * (side / 2 + 0.03)
                    down = math.radians(58.0)
                    depth = away + py * math.cos(down) - z * math.sin(down)
                    tall = max(tall, abs(py * math.sin(down) + z * math.cos(down)) / depth)
                    wide = max(wide, abs(px) / depth)
        field = math.tan(math.radians(20.0))
        # Either the height or the width fits exactly, with a margin of 6 %.
        share = max(tall / field, wide / (field * aspect))
        assert share == pytest.approx(1 / 1.06, rel=1e-9)


def test_pictures_are_spread_evenly_over_time():
    settings = _settings("task.control_step=0.05")
    episode = replays.episode(replays.wandering(1, 11), replays.wandering(1, 6))
    # A picture lasts 1/30 s, so 10 steps of 0.05 s make 15 pictures.
    rows = video.rows(settings, episode.runs)
    assert rows[:15] == [math.floor(k / 1.5) for k in range(15)]
    assert rows[15:] == [10] * 30  # the last frame is held for one second


def test_things_have_their_true_sizes():
    settings, run = _settings(), replays.wandering(3, 2)
    model = video.build(settings, run).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    kinds, sizes, places = model.geom_type, model.geom_size, data.geom_xpos
    cylinder, box = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX
    discs = np.flatnonzero((kinds == cylinder) & np.isclose(sizes[:, 0], 0.05))
    np.testing.assert_allclose(places[discs, :2], run.target[0])
    hulls = np.flatnonzero((kinds == cylinder) & np.isclose(sizes[:, 0], 0.037))
    assert len(hulls) == 3
    np.testing.assert_allclose(sizes[hulls, 1], 0.5 * 0.045)  # the hull is 45 mm high
    boxes = np.flatnonzero((kinds == box) & (model.geom_bodyid == 0))
    inner = np.abs(places[boxes, :2]).max(axis=-1) - sizes[boxes, 0]
    walls = boxes[np.isclose(inner, 0.5 * run.scene.side)]
    assert len(walls) == 4
    (obstacle,) = set(boxes) - set(walls)
    np.testing.assert_allclose(sizes[obstacle, :2], 0.05)
    np.testing.assert_allclose(places[obstacle, :2], [0.1, -0.2])
    assert not model.geom_contype.any()


def test_without_opengl_or_ffmpeg_it_says_what_to_install(monkeypatch):
    def fail(*_):
        raise RuntimeError

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(ConfigError, match=r"^video cannot be made here .* set MUJOCO_GL to egl "):
        video.check()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r"^video cannot be made here .* uv sync --extra video"):
        video.check()


# MuJoCo chooses its OpenGL when it is imported, so the test needs a separate process.
_FILM = """
import sys
try:
    import mujoco  # which loads the library that MUJOCO_GL names
except Exception:
    sys.exit(77)
import numpy as np, imageio.v2 as imageio, replays
from pathlib import Path
from swarmjax.config import ConfigError
from swarmjax.replay import video
from swarmjax.replay.config import ReplayConfig
from swarmjax.task.stage_files import load_levels
try:
    video.check()
except ConfigError:
    sys.exit(77)
video.HEIGHT, video.HOLD = 240, 0.1
run = replays.wandering(2, 4)
run.pose[:, :, :2] = run.target[:] = [[-0.3, -0.3], [0.3, 0.3]]
settings = load_levels(ReplayConfig, ["policy=a", "task.control_step=0.064"])
out = Path(sys.argv[1])
video.write(out, settings, [replays.episode(run, run)])
film = imageio.get_reader(out)
pictures = [film.get_data(i) for i in range(film.count_frames())]
np.savez(sys.argv[2], count=len(pictures), picture=pictures[0])
film.close()
"""


@pytest.mark.slow
def test_a_film_shows_the_robots(tmp_path):
    out, found = tmp_path / "film.mp4", tmp_path / "found.npz"
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    folders = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", _FILM, out, found],
        env={"MUJOCO_GL": "egl"} | os.environ | {"PYTHONPATH": folders},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode == 77:
        pytest.skip("needs OpenGL: Debian's libegl1 and libgl1-mesa-dri, or libosmesa6")
    assert done.returncode == 0, done.stderr
    with np.load(found) as arrays:
        count, picture = int(arrays["count"]), arrays["picture"].astype(int)
    # Three steps of 0.064 s make 5.76 pictures of 1/30 s. The last frame is held for
    # 0.1 s.
    assert count == 6 + 3
    assert picture.shape == (240, 2 * 320, 3)
    for half in (picture[:, :320], picture[:, 320:]):
        blue = (half[..., 2] > 100) & (half[..., 2] > 2 * half[..., 0])
        rows, columns = np.nonzero(blue)  # robot 0, lower left
        assert len(rows) > 50
        assert rows.mean() > 120
        assert columns.mean() < 160
