"""Tests `python -m swarmjax.reproduce` from end to end with few steps, and all its refusals."""

import itertools
import json
import sys
from pathlib import Path

import pytest
from sentences import refusal

from swarmjax import command, provenance
from swarmjax.config import files
from swarmjax.reproduce import __main__ as reproduce
from swarmjax.reproduce import page as reproduce_page
from swarmjax.reproduce import rows as reproduce_rows
from swarmjax.reproduce.config import ReproduceConfig

# Eight updates of 750 control steps each, in the paper's world.
TINY = ["arms=[baseline]", "seeds=3", "budget=6000"]
SHORT = ("algo.rollout_length=750", "algo.epochs=2", "task.step_limit=32", "sim.impl=jax")


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> list[reproduce_rows.Reproduction]:
    """Replaces the page, which has its own tests, and returns the reproductions it would show."""
    found: list[reproduce_rows.Reproduction] = []

    def write(out: Path) -> Path:
        found.append(reproduce_rows.read(out))
        return out / "report.html"

    monkeypatch.setattr(reproduce_page, "write", write)
    return found


@pytest.mark.slow
def test_what_was_stopped_goes_on_and_is_judged(
    tmp_path: Path,
    pages: list,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reproduce.arms, "PAPER", ("algo=paper", *SHORT))
    monkeypatch.setattr(reproduce.judge, "EPISODES", 2)
    monkeypatch.setattr(provenance, "cores", lambda: 1)  # judges in this process
    out = tmp_path / "out"
    # The time limit ends before the first arm begins.
    assert reproduce.main([*TINY, f"out={out}", "minutes=0.0001"]) == 0
    assert capsys.readouterr().out == (
        f"stopped and saved, with 1 of 1 arms left to train; continue with: python -m "
        "swarmjax.reproduce "
        f"resume={out}\n"
    )
    assert not pages
    facts = json.loads((out / "reproduce.json").read_text())
    assert facts["settings"]["budget"] == 6000
    assert reproduce_rows.summaries(out) == {}
    # A process that is killed before it saves anything leaves only a config. The run then resumes
    # from the config.
    assert reproduce.main([f"resume={out}"]) == 0
    (found,) = pages
    assert (found.seeds, list(found.logs)) == (range(3), ["baseline"])
    lines = (out / "baseline" / "metrics.jsonl").read_text().splitlines()
    metrics = [json.loads(line) for line in lines]
    for log, seed in zip(found.logs["baseline"], found.seeds, strict=True):
        mine = [row for row in metrics if row["seed"] == seed]
        assert len(mine) == 8
        assert len(log) == sum(row["episodes"] for row in mine) >= 160  # up to 32 steps per episode
        assert log.sensed.sum() == sum(row["sensed"] for row in mine)
    rows = json.loads((out / "evaluation.json").read_text())["rows"]
    named = [(row["arm"], row["seed"], row["stage"], row["action"]) for row in rows]
    stages, actions = ("paper6", "paper_expanded"), ("sampled", "mean")
    assert named == [*itertools.product(["baseline"], range(3), stages, actions)]
    # Everything is finished, so nothing is trained or judged again.
    before = {path: path.stat().st_mtime_ns for path in (out / "baseline").rglob("*")}
    assert reproduce.main([f"resume={out}"]) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "baseline").rglob("*")} == before
    assert json.loads((out / "evaluation.json").read_text())["rows"] == rows


def test_another_directory_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "reproduce.json").write_text("{}")
    assert refusal(reproduce.main, [f"out={tmp_path}"]) == (
        f"out is {tmp_path}, which is not empty: give a new or an empty folder, or "
        f"resume={tmp_path} to continue the reproduction in it."
    )


def test_what_is_no_reproduction_is_not_gone_on_with(tmp_path: Path) -> None:
    assert refusal(reproduce.main, [f"resume={tmp_path}"]) == (
        f"{tmp_path} is not a reproduction: it has no reproduce.json."
    )
    stored = {"format": 3, "settings": {"seeds": 3}, "versions": {}}
    (tmp_path / "reproduce.json").write_text(json.dumps(stored))
    assert refusal(reproduce.main, [f"resume={tmp_path}", "budget=1e6"]) == (
        "budget cannot be given with resume: leave it out."
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["seeds=2"], "seeds is 2: give 3 to 4096."),
        (["budget=5999"], "budget is 5999: give 6000 to 2147483647."),
        (["fine_tune=1"], "fine_tune is 1: give 6000 to 2147483647."),
        (["arms=[]"],
         "arms is []: give at least one of curriculum, baseline, curriculum_expanded, "
         "baseline_expanded, modern_curriculum, modern_baseline."),
        (["arms=[baseline_expanded]"],
         "arms lists baseline_expanded, which continues baseline: add baseline."),
        (["minutes=0"], "minutes is 0: give more than 0."),
        (["buget=1"], "buget is not a key: did you mean budget?"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(words: list[str], sentence: str) -> None:
    assert refusal(files.load, ReproduceConfig, words) == sentence


def test_help_lists_every_key(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["reproduce", "--help"])
    assert command.run("reproduce", reproduce.main, ReproduceConfig) == 0
    text = capsys.readouterr().out
    assert "  minutes=null" in text
    assert files.defaults("reproduce") == {}
