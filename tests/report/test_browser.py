"""Tests the report in headless Chromium, as wide as a telephone."""

from collections.abc import Iterator
from typing import Any

import chromium
import pytest
from runs import row, write

from swarmjax.report import __main__ as report

pytestmark = chromium.needed


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Opens the report of a curriculum 390 pixels wide."""
    out = tmp_path_factory.mktemp("out")
    run = write(out / "run", [row(i, success_by_stage=[0.5, 0.5], entropy=0.5) for i in range(3)])
    *_, file = report.write(run, out, "make it")
    for browser in chromium.browsers(tmp_path_factory.mktemp("profile")):
        size = {"width": 390, "height": 900, "deviceScaleFactor": 1, "mobile": True}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(file.as_uri())
        yield browser


def _width(page: Any, selector: str, what: str = "offsetWidth") -> int:
    return page.execute_script(f"return document.querySelector({selector!r}).{what}")


def test_the_page_does_not_scroll_sideways(page: Any) -> None:
    assert _width(page, "html", "scrollWidth") == 390


def test_the_learning_curve_is_shown_whole(page: Any) -> None:
    assert 340 < _width(page, "#success img") <= 390


@pytest.mark.parametrize("name", ["stages", "curves"])
def test_a_figure_of_many_panels_scrolls_in_its_own_box(page: Any, name: str) -> None:
    assert _width(page, f"#{name} img") == 560
    assert _width(page, f"#{name} .picture") <= 390


def test_a_table_scrolls_in_its_own_box(page: Any) -> None:
    assert _width(page, ".scroll", "clientWidth") <= 390
    assert _width(page, ".scroll", "scrollWidth") > 390
