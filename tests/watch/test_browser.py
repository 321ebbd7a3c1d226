"""Tests the page of a run in headless Chromium, served only on the loopback interface."""

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import chromium
import pytest
from runs import CONFIG, row, write

from swarmjax.run.checkpoint import Checkpoints
from swarmjax.run.run import Run
from swarmjax.run.settings import RunConfig
from swarmjax.watch.config import WatchConfig
from swarmjax.watch.server import Server
from swarmjax.watch.view import Views

pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.support.ui import WebDriverWait

HOSTILE = "<img src=x onerror=document.title='in'>"
TRAINED = replace(CONFIG, seeds=2, run=RunConfig(id="0123456789abcdef"))


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    """Returns the views of a stopped run of two seeds, whose directory's name is an HTML tag."""
    rows = [row(update, seed) for update in range(TRAINED.updates - 1) for seed in (0, 1)]
    run = write(tmp_path_factory.mktemp("runs") / HOSTILE, rows, trained=TRAINED)
    begun = Run(TRAINED)
    begun.load()
    with Checkpoints(run) as checkpoints:
        checkpoints.save(begun.state, 0)
    made = Views(WatchConfig(run=str(run)))
    made.draw()
    made.record()
    return made


@pytest.fixture(scope="module")
def server(views: Views) -> Iterator[Server]:
    with Server(0, views) as made:
        threading.Thread(target=made.serve_forever, daemon=True).start()
        yield made
        made.shutdown()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from chromium.browsers(tmp_path_factory.mktemp("profile"))


def test_the_newest_policy_of_the_first_seed_is_replayed(views: Views) -> None:
    assert views.replaying == {
        "version": 1,
        "sentence": "Level 0 of stage pair, by the policy of seed 0 after 0 updates.",
        "trouble": "",
    }


def test_a_policy_is_replayed_once(views: Views) -> None:
    before = views.replaying
    assert views.record() == 0.0
    assert views.replaying is before


@chromium.needed
def test_the_page_follows_a_run_and_asks_nobody_else(browser: Any, server: Server) -> None:
    browser.get("about:blank")  # the browser's own start page makes many requests
    for log in ("performance", "browser"):
        browser.get_log(log)  # reading a log empties it
    browser.get(server.url)
    wait = WebDriverWait(browser, 60)
    drawn = "return document.querySelectorAll('figure:not([hidden])').length"
    wait.until(lambda _: browser.execute_script(drawn) == 2)
    status = browser.find_element("id", "status")
    assert status.text.startswith("It has stopped after 19 of 20 updates. ")
    assert "seeds\n0 to 1" in browser.find_element("id", "facts").text
    assert "by the policy of seed 0" in browser.find_element("id", "seen").text
    browser.switch_to.frame("replay")
    wait.until(lambda _: browser.execute_script("return !!window.replay?.ready"))
    browser.switch_to.default_content()
    # The page shows the run's name as text, not as HTML.
    assert browser.title == f"Watching {server.views.run}"
    assert browser.find_element("css selector", "h1").text.endswith(HOSTILE)
    seen = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = {
        each["params"]["request"]["url"]
        for each in seen
        if each["method"] == "Network.requestWillBeSent"
    }
    paths = {url.removeprefix(server.url) for url in asked if url.startswith(server.url)}
    assert len(paths) == len(asked - {"data:,"})  # the icon is an empty data URL
    assert {"", "state.json", "figures/success.png?1", "replay.html?1"} <= paths
    assert browser.get_log("browser") == []  # no errors, no breach of the security policy


@chromium.needed
@pytest.mark.slow
def test_it_says_when_its_server_is_gone(browser: Any, views: Views) -> None:
    with Server(0, views) as gone:
        thread = threading.Thread(target=gone.serve_forever, daemon=True)
        thread.start()
        browser.get(gone.url)
        gone.shutdown()
    trouble = browser.find_element("id", "trouble")
    WebDriverWait(browser, 60).until(lambda _: "has ended" in trouble.text)
