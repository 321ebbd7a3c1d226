"""Tests the report in headless Chromium, opened from a file and without a network."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chromium
import pytest
from reproductions import whole

from swarmjax.reproduce import page as reproduce_page

pytestmark = chromium.needed


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from chromium.browsers(tmp_path_factory.mktemp("profile"))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Writes the report of the two arms that the paper compares."""
    out = tmp_path_factory.mktemp("out")
    return reproduce_page.write(whole(out, arms=("curriculum", "baseline")))


def _open(browser: Any, file: Path, width: int = 1200) -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    for log in ("performance", "browser"):
        browser.get_log(log)  # reading empties it
    browser.get(file.as_uri())


@pytest.mark.slow
def test_it_opens_from_a_file_and_asks_for_nothing_else(browser: Any, file: Path) -> None:
    _open(browser, file)
    seen = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = {
        each["params"]["request"]["url"]
        for each in seen
        if each["method"] == "Network.requestWillBeSent"
    }
    assert file.as_uri() in asked
    # Everything else is inside the page.
    assert all(url == file.as_uri() or url.startswith("data:") for url in asked)
    assert browser.get_log("browser") == []  # no violation of the page's content policy


def test_its_figures_are_shown(browser: Any, file: Path) -> None:
    _open(browser, file)
    script = "return [...document.images].map((i) => [i.complete, i.naturalWidth, i.offsetWidth])"
    found = browser.execute_script(script)
    assert len(found) == len(list((file.parent / "figures").glob("*.png"))) == 6
    for complete, natural, shown in found:
        assert complete
        assert natural == shown > 900


@pytest.mark.parametrize(("width", "dark"), [(400, False), (1200, False), (900, True)])
def test_it_fits_in_light_and_dark(browser: Any, file: Path, width: int, dark: bool) -> None:
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    _open(browser, file, width)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    card = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert card == ("rgb(20, 21, 23)" if dark else "rgb(251, 251, 250)")
