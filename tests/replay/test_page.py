"""Tests that the replay page is one file that fetches nothing and keeps hostile text harmless."""

import base64
import hashlib
import re
from html.parser import HTMLParser

import replays
import steering

from swarmjax import policy_file
from swarmjax.replay import page as replay_page
from swarmjax.replay.config import ReplayConfig
from swarmjax.task.stage_files import load_levels

HOSTILE = "</script><script>document.title='in'</script><img src=x onerror=alert(1)>&amp;"


class Page(HTMLParser):
    """Parses a page into tags with attributes, and the texts inside each kind of tag."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags:
            self.texts.setdefault(self.tags[-1][0], []).append(data)


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def test_a_hostile_title_stays_text():
    page = Page(replay_page.fill(HOSTILE, b"data"))
    assert page.texts["title"][0] == page.texts["h1"][0] == HOSTILE
    assert [tag for tag, _ in page.tags].count("script") == 2
    assert "img" not in [tag for tag, _ in page.tags]


def test_hostile_names_are_nowhere_in_the_page(tmp_path):
    path = steering.write(tmp_path / "steer.npz")
    names = [f"policy={HOSTILE},{HOSTILE}b", "worst=2", "realism=real"]
    settings = load_levels(ReplayConfig, names)
    trained = policy_file.read(path)
    run = replays.wandering(2, 5)
    text = replay_page.page(settings, [trained] * 2, [replays.episode(run, run)], f"run {HOSTILE}")
    assert HOSTILE not in text
    assert "<img" not in text
    assert text.count("<script") == text.count("</script>") == 2


def test_the_page_allows_itself_its_own_script_and_style_alone():
    text = replay_page.fill("title", b"data")
    page = Page(text)
    (allowed,) = (
        attrs["content"]
        for tag, attrs in page.tags
        if tag == "meta" and attrs.get("http-equiv") == "Content-Security-Policy"
    )
    assert allowed is not None
    rules = dict(rule.strip().split(" ", 1) for rule in allowed.split(";"))
    assert rules["default-src"] == "'none'"
    script = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    style = re.findall(r"<style>(.*?)</style>", text, re.DOTALL)
    assert rules["script-src"] == f"'sha256-{_hash(script[0])}'"
    assert rules["style-src"] == f"'sha256-{_hash(style[0])}'"
    assert len(script) == len(style) == 1
    # Nothing is fetched: the only address in a tag is the empty icon.
    sources = [v for _, attrs in page.tags for k, v in attrs.items() if k in ("src", "href")]
    assert sources == ["data:,"]
    assert not re.search(r"https?:|url\(|@import|fetch\(|XMLHttpRequest|WebSocket", text)


def test_the_data_are_in_it():
    text = replay_page.fill("title", b"\x00\xff<data>")
    (data,) = re.findall(r'id="data">(.*?)</script>', text)
    assert base64.b64decode(data) == b"\x00\xff<data>"
