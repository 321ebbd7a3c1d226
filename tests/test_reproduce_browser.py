"""The report in a browser: Chromium without a window, from a file, without a network."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from reproductions import whole

from swarmjax import reproduce_page

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.chrome.service import Service  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="needs Debian's chromium and chromium-driver"
)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of the two arms that the paper compares."""
    out = tmp_path_factory.mktemp("out")
    return reproduce_page.write(whole(out, arms=("curriculum", "baseline")))


def _open(browser: Any, file: Path, width: int = 1200) -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    for log in ("performance", "browser"):
        browser.get_log(log)  # reading empties it
    browser.get(file.as_uri())


def test_it_opens_from_a_file_and_asks_for_nothing_else(browser: Any, file: Path) -> None:
    _open(browser, file)
    seen = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = {
        each["params"]["request"]["url"]
        for each in seen
        if each["method"] == "Network.requestWillBeSent"
    }
    assert file.as_uri() in asked
    # All else is inside the page.
    assert all(url == file.as_uri() or url.startswith("data:") for url in asked)
    assert browser.get_log("browser") == []  # nothing that the page forbids itself


def test_its_figures_are_shown(browser: Any, file: Path) -> None:
    _open(browser, file)
    script = "return [...document.images].map((i) => [i.complete, i.naturalWidth, i.offsetWidth])"
    found = browser.execute_script(script)
    assert len(found) == len(list((file.parent / "figures").iterdir())) == 7
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
