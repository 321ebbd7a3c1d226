"""Checks the page of a report, parsed as by a browser, for the results of the run."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

from runs import CONFIG, row, write

from swarmjax.report import page as report_page
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import History
from swarmjax.run.settings import RunConfig

FIGURES = {"success": b"\x89PNG-success", "mix": b"\x89PNG-mix"}


class Page(HTMLParser):
    """A parsed page: its tags with attributes, and the texts of its table cells and facts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        tag = self.tags[-1][0] if self.tags else ""
        if tag in ("td", "th"):
            self.rows[-1][-1] += data.strip()
        elif data.strip():
            self.words.append(data.strip())

    def fact(self, name: str) -> str:
        """Returns the text after a name in the summary."""
        return self.words[self.words.index(name) + 1]


def _history(run: Path, rows: list[dict], decisions: list[dict] | None = None) -> History:
    return report_rows.read(write(run, rows, decisions))


def _page(history: History, title: str = "a run", command: str = "make it") -> Page:
    return Page(report_page.page(title, command, history, FIGURES))


def test_the_summary_says_where_the_run_stands(tmp_path: Path) -> None:
    shares = [(0.95, 0.5), (0.85, 0.625), (0.93, None)]
    rows = [row(3, seed, success_by_stage=list(two)) for seed, two in enumerate(shares)]
    decisions = [{"seed": 0, "update": 1, "why": why} for why in ("budget", "budget", "threshold")]
    page = _page(_history(tmp_path, rows, decisions))
    assert page.fact("stages") == "2: pair to trio"
    assert page.fact("seeds") == "0 to 2"
    # The budget is 20 updates of 64 steps; an update takes 30 s.
    assert page.fact("trained") == (
        "4 of 20 updates, 256 arena control steps per seed, 8 arenas, 2 min 00 s"
    )
    # At most three values are not trimmed, and the mean of 0.5 and 0.625 is 0.5625.
    assert page.fact("last stage") == (
        "trio: targets reached 56.2 % (interquartile mean of 2 of 3 seeds, 50.0 % to 62.5 %)"
    )
    assert page.fact("computed by") == "not recorded before the end of the run"
    assert "threshold=0.8" in page.fact("curriculum")
    assert page.fact("made by") == "make it"


def test_the_summary_says_that_a_run_stopped_at_its_success(tmp_path: Path) -> None:
    history = _history(tmp_path, [row(0), row(1)])
    config = replace(history.config, run=RunConfig(stop_at=0.9))
    history = replace(history, config=config, summary={"updates": 2, "stopped_at": 0.9})
    assert _page(history).fact("trained").startswith("2 of 20 updates (run.stop_at is reached), ")


def test_a_run_that_measured_nothing_has_a_page(tmp_path: Path) -> None:
    history = replace(_history(tmp_path, [row(0)]), seconds=None)
    page = _page(history)
    unmeasured = "not measured: too little training on this stage so far"
    assert page.fact("last stage") == unmeasured
    assert page.fact("Promotions") == "None. The shares of the stages changed 0 times."
    assert "min" not in page.fact("trained")
    assert ["pair", "2", "any", "0", "0.5", "100.0 %", "-", "-", "-", "-", "0 of 1"] in page.rows


def test_the_settings_come_last(tmp_path: Path) -> None:
    words = _page(_history(tmp_path, [row(0)])).words
    parts = ["last stage", "Promotions", "Stages", "Settings", "curriculum", "made by"]
    assert [each for each in words if each in parts] == parts


def test_the_learning_curve_comes_first(tmp_path: Path) -> None:
    tags = [tag for tag, _ in _page(_history(tmp_path, [row(0)])).tags]
    assert tags.index("figure") < tags.index("dl")


def test_a_run_of_one_stage_has_no_curriculum(tmp_path: Path) -> None:
    short = {key: value[:1] for key, value in row(0).items() if isinstance(value, list)}
    trained = replace(CONFIG, stage=CONFIG.stage[:1], stage_name="")
    run = write(tmp_path, [row(0) | short], trained=trained)
    words = _page(report_rows.read(run)).words
    assert not {"Promotions", "stages", "curriculum"} & set(words)


def test_a_replay_is_linked_from_the_folder_of_the_report(tmp_path: Path) -> None:
    run = write(tmp_path / "a #1", [row(0)])
    (run / "replay.html").touch()
    found = report_page.replay(run, tmp_path / "reports")
    assert found == ("../a #1/replay.html", "")
    text = report_page.page("a run", "make it", report_rows.read(run), FIGURES, found)
    assert ("a", {"href": "../a%20%231/replay.html"}) in Page(text).tags


def test_without_a_replay_its_command_is_given(tmp_path: Path) -> None:
    history = _history(tmp_path, [row(0)])
    (tmp_path / "policy.npz").touch()
    found = report_page.replay(tmp_path, tmp_path)
    how = f"python -m swarmjax.replay policy={tmp_path}/policy.npz out={tmp_path}/replay.html"
    assert found == ("", how)
    assert how in Page(report_page.page("a run", "make it", history, FIGURES, found)).words


def test_a_single_seed_has_no_range(tmp_path: Path) -> None:
    page = _page(_history(tmp_path, [row(0, 4, success_by_stage=[None, 0.5])]))
    assert page.fact("last stage") == "trio: targets reached 50.0 %"
    assert page.fact("seeds") == "4"


def test_where_it_was_computed_is_taken_from_the_summary(tmp_path: Path) -> None:
    write(tmp_path, [row(0)])
    (tmp_path / "summary.json").write_text('{"device": "a chip", "commit": null}')
    assert _page(report_rows.read(tmp_path)).fact("computed by") == "a chip, commit unknown"


def test_promotions_are_tabled(tmp_path: Path) -> None:
    moved = {
        "from": "pair",
        "to": "trio",
        "why": "threshold",
        "targets_reached": 0.875,
        "all_reached": 0.75,
    }
    decisions = [
        {"seed": 1, "update": 3, **moved},
        {"seed": 0, "update": 5, "from": "trio", "to": "pair", "why": "budget"},
        {"seed": 0, "update": 7, "why": "reweighed", "weights": {"n0": 1.0}},
        {"seed": 0, "update": 9, "why": "reweighed", "weights": {"n0": None}},
    ]
    page = _page(_history(tmp_path, [row(0)], decisions))
    rows = page.rows
    # An update is 64 arena control steps.
    assert ["1", "4", "256", "pair", "trio", "threshold", "87.5 %", "75.0 %"] in rows
    assert ["0", "6", "384", "trio", "pair", "budget", "-", "-"] in rows


def test_stages_are_tabled_with_their_last_figures(tmp_path: Path) -> None:
    last = {
        "success_by_stage": [0.75, 0.5],
        "complete_by_stage": [0.5, 0.25],
        "contacts_by_stage": [1.25, None],
        "return_by_stage": [-0.5, 2.0],
    }
    rows = [row(0, mix=[8, 0]), row(1, mix=[6, 2], **last)]
    found = _page(_history(tmp_path, rows)).rows
    # 14 of 16 arenas were on the first stage.
    assert [
        "pair",
        "2",
        "any",
        "0",
        "0.5",
        "87.5 %",
        "75.0 %",
        "50.0 %",
        "1.25",
        "-0.5",
        "1 of 1",
    ] in found
    trio = ["trio", "3", "any", "2", "0.8", "12.5 %", "50.0 %", "25.0 %", "-", "2", "1 of 1"]
    assert trio in found


def test_stages_along_axes_are_labelled_by_their_values(tmp_path: Path) -> None:
    decisions = [{"seed": 0, "update": 0, "why": "reweighed", "weights": {"pair": 1.0}}]
    history = _history(tmp_path, [row(0)], decisions)
    axes = replace(history.config.curriculum, axes={"robots": [2], "distance": []})
    easy = replace(history.config.stage[0], distance=(0.1, 0.25))
    stage = (easy, history.config.stage[1])
    grid = replace(history, config=replace(history.config, curriculum=axes, stage=stage))
    page = _page(grid)
    assert grid.labels == ["2 · 0.1 to 0.25", "3 · any"]
    assert page.fact("stages") == "2: 2 · 0.1 to 0.25 to 3 · any; by robots · distance"
    assert page.fact("Promotions") == "None. The shares of the stages changed 1 time."


def test_what_comes_from_outside_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert('&')</script>"
    decisions = [
        {"seed": 0, "update": 1, "from": evil, "to": evil, "why": evil},
        {"seed": 0, "update": 2, "why": evil, "weights": {evil: 1.0}},
    ]
    write(tmp_path, [row(0)], decisions)
    (tmp_path / "summary.json").write_text(f'{{"device": "{evil}", "commit": "{evil}"}}')
    page = _page(report_rows.read(tmp_path), title=evil, command=evil)
    assert "script" not in {tag for tag, _ in page.tags}
    assert [given for tag, given in page.tags if tag == "link"] == [
        {"rel": "icon", "href": "data:,"}
    ]
    assert ["0", "2", "128", evil, evil, evil, "-", "-"] in page.rows
    assert page.fact("made by") == evil
    assert evil in page.words  # the title


def test_the_page_needs_nothing_else(tmp_path: Path) -> None:
    history = _history(tmp_path, [row(0)])
    text = report_page.page("a run", "make it", history, FIGURES)
    sources = [attributes.get("src") for tag, attributes in Page(text).tags if tag == "img"]
    start = "data:image/png;base64,"
    found = [base64.b64decode((source or "").removeprefix(start)) for source in sources]
    assert found == list(FIGURES.values())
    assert not re.search(r"https?:|url\(|@import", text)
