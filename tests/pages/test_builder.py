"""Checks the frame of every page: escapes, what a browser may load, and refusals."""

import base64
import hashlib
import re
from pathlib import Path

import jinja2
import pytest
from sentences import refusal

import swarmjax
from swarmjax.pages import builder

HOSTILE = "</style></script><script>alert(1)</script><img src=x onerror=alert(1)>&amp;{{ 7 * 7 }}"
TEMPLATES = sorted(Path(swarmjax.__file__).parent.glob("*/templates/*.html"))
RUNS = {"title": "a title", "heads": ["a"], "rows": [], "note": "a note", "command": "make it"}
TABLE = """{% extends "pages/base.html" %}{% from "pages/parts.html" import table %}
{% block body %}<h1>{{ title }}</h1>{{ table(heads, rows) }}{{ note }} {{ command }}{% endblock %}
"""


@pytest.fixture(autouse=True)
def _small_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Adds a small page to the templates of the package."""
    templates = builder._TEMPLATES
    loaders = [jinja2.DictLoader({"table.html": TABLE}), jinja2.FunctionLoader(builder.read)]
    monkeypatch.setattr(templates, "loader", jinja2.ChoiceLoader(loaders))


def _table(**given: object) -> str:
    return builder.render("table.html", **(RUNS | given))


def _policy(page: str) -> dict[str, str]:
    """Returns the directives of a page's content security policy."""
    (found,) = re.findall(r'Content-Security-Policy" content="(.*?)"', page)
    rules = found.replace("&#39;", "'").split("; ")
    return dict(rule.split(" ", 1) for rule in rules)


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


@pytest.mark.parametrize("key", ["title", "note", "command"])
def test_a_value_is_text_and_no_template(key: str) -> None:
    page = _table(**{key: HOSTILE})
    assert "<script" not in page
    assert "<img" not in page
    assert "{{ 7 * 7 }}" in page


def test_cells_are_text() -> None:
    page = _table(heads=[HOSTILE], rows=[[HOSTILE]])
    assert "<script" not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;&amp;amp;") == 2


def test_a_cell_of_none_is_a_dash_and_an_empty_one_is_empty() -> None:
    page = _table(heads=["a", "b", "c"], rows=[[None, "", 0]])
    assert "<tr><td>-</td><td></td><td>0</td></tr>" in page


def test_a_page_without_a_script_may_run_none() -> None:
    page = _table()
    (style,) = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    assert _policy(page) == {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": _hash(style),
        "base-uri": "'none'",
        "form-action": "'none'",
    }


def test_a_page_may_run_its_own_script_alone() -> None:
    script = "if (1 < 2 && 'a') say('b');"
    page = _table(script=script)
    assert f"<script>{script}</script>" in page
    found = _policy(page)
    assert found["script-src"] == _hash(script)
    assert found["default-src"] == "'none'"


def test_styles_follow_one_another() -> None:
    names = (builder.STYLE, "report/report.css")
    (style,) = re.findall(r"<style>(.*?)</style>", _table(styles=names), re.DOTALL)
    assert style == "".join(map(builder.read, names))


def test_a_value_that_is_missing_is_no_empty_text() -> None:
    with pytest.raises(jinja2.UndefinedError, match="note"):
        builder.render("table.html", title="", heads=[], rows=[], command="")


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.name)
def test_the_frame_alone_trusts_a_text(path: Path) -> None:
    trusted = re.findall(r"\|\s*safe|autoescape|Markup", path.read_text())
    assert trusted == (["| safe"] * 2 if path.name == "base.html" else [])


def test_files_are_written_into_folders_that_are_made(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    written = builder.write(out, {"figures/a.png": b"a", "page.html": b"b"})
    assert written == [out / "figures" / "a.png", out / "page.html"]
    assert [path.read_bytes() for path in written] == [b"a", b"b"]


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("in the way")
    said = refusal(builder.write, tmp_path / "out", {"page.html": b""})
    assert said == f"out is {tmp_path / 'out'}, which cannot be written: File exists."
