"""Tests that the report of a reproduction, parsed as HTML, states the numbers of its data."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from reproductions import SEEDS, SUMMARY, episode, row, whole, write
from sentences import refusal

from swarmjax.reproduce import claims as reproduce_claims
from swarmjax.reproduce import page as reproduce_page
from swarmjax.reproduce.rows import ACTIONS, EXPANDED, LAST

PAIR = ("curriculum", "baseline")
HOSTILE = "</style><script>alert(1)</script>"


class Page(HTMLParser):
    """Parses a page into tags with attributes, rows of tables, and the whole text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []
        self.text = ""
        self.in_cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self.in_cell = True

    def handle_endtag(self, tag: str) -> None:
        self.in_cell = self.in_cell and tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        self.text += data
        if self.in_cell:
            self.rows[-1][-1] += data.strip()

    def starting(self, *cells: str) -> list[list[str]]:
        """Returns the rows that begin with these cells."""
        return [found for found in self.rows if found[: len(cells)] == list(cells)]


@pytest.fixture(scope="module")
def partial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Page]:
    """Writes a reproduction in which only curriculum and baseline have finished.

    The three seeds reach a share of 0.5, 0.75 and 1 of their targets.
    """
    out = tmp_path_factory.mktemp("out")
    whole(out, arms=PAIR)
    judged = [
        row(arm, seed, stage, action, targets_reached=0.5 + seed / 4)
        for arm in PAIR
        for seed in SEEDS
        for stage in (LAST, EXPANDED)
        for action in ACTIONS
    ]
    (out / "evaluation.json").write_text(json.dumps({"format": 4, "rows": judged}))
    hostile = SUMMARY | {"commit": HOSTILE, "device": None, "train_s": None}
    (out / "baseline" / "summary.json").write_text(json.dumps(hostile))
    page = reproduce_page.write(out)
    assert page == out / "report.html"
    return out, Page(page.read_text())


def test_the_header_says_how_the_data_came_about(partial: tuple[Path, Page]) -> None:
    _, page = partial
    assert "python -m swarmjax.reproduce seeds=3 budget=1000000 fine_tune=250000" in page.text
    assert "1,000,000 arena control steps of each seed" in page.text
    assert HOSTILE in page.text
    made = ["60 s", "60 s", "CPU x86_64, 2 cores"]
    assert page.starting("curriculum")[0] == [
        "curriculum",
        "the paper's algorithm with its curriculum",
        *made,
    ]
    assert page.starting("baseline")[0][2:] == ["unknown", "60 s", "unknown"]
    assert page.starting("modern_baseline")[0][2:] == ["not trained to the end", "", ""]


def test_the_table_that_the_paper_lacks(partial: tuple[Path, Page]) -> None:
    _, page = partial
    [found] = page.starting("baseline", LAST, "mean")
    # The interquartile mean of three values trims none. The interval goes from the lowest to the
    # highest value, since one of 27 resamples holds the lowest three times, and one the highest.
    assert found[3] == "75.0 % (50.0 to 100.0)"
    assert found[4:] == [
        "60.0 % (60.0 to 60.0)",
        "10.0 % (10.0 to 10.0)",
        "1.5 (1.5 to 1.5)",
    ]


def test_where_success_becomes_steady(partial: tuple[Path, Page]) -> None:
    _, page = partial
    goal = "robot 1 reached its target"
    # The first ten episodes fail, and a window of 20 may hold four failures, so success is steady
    # from episode 7 on. On the last stage only five episodes fail. The second of these failures is
    # episode 7 of the run, which ends at 700 arena steps.
    everything, on_last = (
        page.starting(goal, "all episodes, episode number", "curriculum")[0],
        (page.starting(goal, f"episodes on {LAST}, arena steps", "curriculum")[0]),
    )
    assert everything[3:] == ["7", "7 (7 to 7)", "3 of 3"]
    assert on_last[3:] == ["700", "700 (700 to 700)", "3 of 3"]
    # The baseline fails in two more episodes, so it is steady two episodes later.
    assert page.starting(goal, "all episodes, episode number", "baseline")[0][3] == "9"


def test_every_claim_has_its_verdict(partial: tuple[Path, Page]) -> None:
    _, page = partial
    for claim in reproduce_claims.CLAIMS:
        [found] = [found for found in page.rows if found[0].startswith(claim.quote)]
        assert re.match("reproduced|not reproduced|undecidable", found[1])
        assert claim.criterion in page.text
    total = re.search(
        r"Of (\d+) claims in the paper.s text: (\d+) reproduced, (\d+) not reproduced, (\d+) und",
        page.text,
    )
    assert total is not None
    count, *parts = map(int, total.groups())
    assert count == len(reproduce_claims.CLAIMS) == sum(parts)


def test_what_is_lacking_is_said(partial: tuple[Path, Page]) -> None:
    _, page = partial
    assert (
        "Not trained to the end, and missing below: curriculum_expanded, baseline_expanded, "
        "modern_curriculum, modern_baseline." in page.text
    )
    assert "Lacks modern_curriculum and modern_baseline, not trained to the end." in page.text
    assert "Not drawn: Figure 9. Lacks curriculum_expanded and baseline_expanded" in page.text


def test_the_page_needs_nothing_else(partial: tuple[Path, Page]) -> None:
    out, page = partial
    names = [tag for tag, _ in page.tags]
    assert not {"script", "iframe", "object", "form"} & set(names)
    sources = [given["src"] for tag, given in page.tags if tag == "img"]
    assert all(source is not None and source.startswith("data:image/png;") for source in sources)
    assert len(sources) == len(list((out / "figures").glob("*.png"))) == 6
    assert [given for tag, given in page.tags if tag == "link"] == [
        {"rel": "icon", "href": "data:,"}
    ]
    assert all(given["alt"] for tag, given in page.tags if tag == "img")


def test_a_single_arm_is_reported(tmp_path: Path) -> None:
    logs = {"baseline": [episode(n, seed=seed) for seed in SEEDS for n in range(1, 4)]}
    page = Page(reproduce_page.write(write(tmp_path, logs)).read_text())
    # Three episodes are fewer than a window, so there is no curve and no steady success.
    [found] = page.starting(
        "robot 1 reached its target", "all episodes, episode number", "baseline"
    )[:1]
    assert found[3:5] == ["never", "never (never to never)"]


def test_short_runs_have_no_verdicts_and_the_page_says_why(tmp_path: Path) -> None:
    out = whole(tmp_path, arms=PAIR)
    facts = json.loads((out / "reproduce.json").read_text())
    facts["settings"]["budget"] = 12_000
    (out / "reproduce.json").write_text(json.dumps(facts))
    page = Page(reproduce_page.write(out).read_text())
    assert "There are no verdicts: these runs are too short." in page.text
    assert "each seed for\n1,000,000 control steps" in page.text
    for claim in reproduce_claims.CLAIMS:
        [found] = [found for found in page.rows if found[0].startswith(claim.quote)]
        assert found[1] == "no verdicttoo short"
        assert not re.search("holds|contradicted|open", found[2])


def test_data_that_are_missing_are_refused(tmp_path: Path) -> None:
    out = whole(tmp_path, arms=PAIR)
    (out / "baseline" / "episodes.jsonl").unlink()
    assert "baseline has no episodes.jsonl" in refusal(reproduce_page.write, out)
    assert not (out / "report.html").exists()


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    out = whole(tmp_path, episodes=2, arms=("baseline",))
    (out / "figures").write_text("in the way")
    assert "cannot be written" in refusal(reproduce_page.write, out)
