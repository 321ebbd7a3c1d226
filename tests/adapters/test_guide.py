"""Checks that the code of docs/adapters.md runs as written."""

import re
from pathlib import Path

import pytest

_GUIDE = (Path(__file__).parents[2] / "docs" / "adapters.md").read_text()
_SECTION = re.compile(r"^## ([^\n]+)\n(?:(?!^## ).)*?^```python\n(.*?)^```", re.M | re.S)
_BLOCKS = dict(_SECTION.findall(_GUIDE))
_TORCH = ("Stable-Baselines3", "PyTorch")


@pytest.mark.parametrize(
    "section",
    [
        pytest.param(each, marks=pytest.mark.torch if each in _TORCH else pytest.mark.slow)
        for each in _BLOCKS
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Brax imports JAXopt, which warns
def test_the_code_of_a_section_runs(section: str) -> None:
    exec(compile(_BLOCKS[section], f"docs/adapters.md, {section}", "exec"), {})


def test_every_adapter_has_code() -> None:
    assert len(_BLOCKS) == len(re.findall(r"^\| \[`", _GUIDE, re.M))
