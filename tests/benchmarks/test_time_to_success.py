"""Tests the time at which each seed of a run first reached its targets."""

import json
from pathlib import Path

import pytest
import runs
from runs import CONFIG, row

from benchmarks import time_to_success


def _summary(**given: object) -> str:
    figures = dict.fromkeys(time_to_success.OF_THE_RUN, 2.5)
    reached = [{"pair": 0.99, "trio": 0.97}, {"pair": 0.5}]
    return json.dumps({"seeds": [0, 1], "targets_reached": reached, **figures, **given})


def _run(folder: Path) -> Path:
    """Writes a run of two seeds on two stages; seed 1 reaches only 0.25 on the last stage."""
    shares = {
        0: [[0.95, None], [0.99, 0.89], [0.99, 0.9], [None, 0.97]],
        1: [[0.95, None], [0.5, None], [0.5, 0.25], [None, 0.25]],
    }
    rows = [
        row(update, seed, success_by_stage=shares[seed][update], broken_arenas=seed)
        for update in range(4)
        for seed in (0, 1)
    ]
    run = runs.write(folder, rows, trained=CONFIG)
    (run / "summary.json").write_text(_summary())
    return run


def test_each_seed_has_a_line_of_its_own(tmp_path: Path) -> None:
    first, second = time_to_success.lines(_run(tmp_path), 0.9)
    # The last stage is the second stage. Update 2 ends at 3 x 30 s and 3 x 64 arena steps.
    assert (first["seed"], first["seconds"], first["arena_steps"]) == (0, 90.0, 192)
    assert (second["seed"], second["seconds"], second["arena_steps"]) == (1, None, None)
    assert (first["final_success"], second["final_success"]) == (0.97, None)
    assert (first["broken_arenas"], second["broken_arenas"]) == (0, 4)
    assert first["transitions_per_s"] == second["transitions_per_s"] == 2.5


def test_an_unfinished_last_line_is_skipped(tmp_path: Path) -> None:
    run = _run(tmp_path)
    whole = time_to_success.lines(run, 0.9)
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"seed": 1, "broken_ar')
    assert time_to_success.lines(run, 0.9) == whole


@pytest.mark.parametrize(
    ("file", "content", "what"),
    [
        ("metrics.jsonl", "{\n", " in line 1 is damaged: resume the run, or remove the line."),
        (
            "metrics.jsonl",
            json.dumps(row(0, broken_arenas=None)) + "\n",
            " in line 1 has no whole number as broken_arenas: it is damaged.",
        ),
        (
            "metrics.jsonl",
            json.dumps(row(0, broken_arenas=0, success_by_stage=[0.5])) + "\n",
            " in line 1 has no list of 2 numbers as success_by_stage: it is damaged.",
        ),
        ("summary.json", "{}", " has no seeds: it is damaged."),
        ("summary.json", "[]", " holds no keys and values: it is damaged."),
        ("summary.json", _summary(seeds=0), " has no list as seeds: it is damaged."),
        (
            "summary.json",
            _summary(targets_reached=[{}]),
            " has no shares of each seed as targets_reached: it is damaged.",
        ),
    ],
)
def test_a_damaged_file_is_named(
    file: str, content: str, what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _run(tmp_path) / file
    path.write_text(content)
    assert time_to_success.main([str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"benchmarks.time_to_success: error: {path}{what}\n"


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["gone"], "gone is no run directory: it has no config.json."),
        (["gone", "most"], "SHARE is most: give a number from 0 to 1."),
        (["gone", "nan"], "SHARE is nan: give a number from 0 to 1."),
    ],
)
def test_errors_are_one_sentence(
    words: list[str],
    what: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert time_to_success.main(words) == 2
    assert capsys.readouterr().err == f"benchmarks.time_to_success: error: {what}\n"
