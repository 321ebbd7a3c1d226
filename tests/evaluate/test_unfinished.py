"""Tests evaluations that resume after a stop between two cells, and cells with a step limit."""

import csv
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import steering

from swarmjax import command
from swarmjax.evaluate import __main__ as evaluate_command
from swarmjax.evaluate import cells
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.suite_config import read_suite
from swarmjax.exit_codes import INTERRUPTED, USER_ERROR

# This script judges, and sends itself a signal once the first cell has been written.
STOPPED = """
import os, signal, sys
from swarmjax.evaluate import __main__, unfinished
write = unfinished.write
def write_and_stop(*arguments):
    write(*arguments)
    os.kill(os.getpid(), int(sys.argv[1]))
unfinished.write = write_and_stop
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's `&` has it ignored
sys.exit(__main__.main(sys.argv[2:]))
"""


def _suite(path: Path, steps: int | None = None, seed: int = 1000002) -> Path:
    """Writes a suite of two small cells; the second cell may have a step limit."""
    limit = "" if steps is None else f", steps: {steps}"
    path.with_suffix(".yaml").write_text(
        "name: tiny\ncells:\n"
        "  - {name: one, stage: s1, levels: 4, seed: 1000001}\n"
        f"  - {{name: two, stage: s3, levels: 5, seed: {seed}{limit}}}\n"
    )
    file = read_suite(str(path.with_suffix(".yaml")))
    cells.write(path, cells.Suite("tiny", tuple(map(cells.draw_cell, file.cells))))
    return path


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Returns the words of an evaluation in the working directory, without `out`."""
    monkeypatch.chdir(tmp_path)
    steering.write(Path("policy.npz"))
    _suite(Path("tiny.npz"))
    return ["policy=policy.npz", "suite=tiny.npz", "steps=60", "workers=1"]


def _stop(words: list[str], number: int = signal.SIGKILL) -> subprocess.CompletedProcess[str]:
    """Judges until the first cell is over."""
    line = [sys.executable, "-c", STOPPED, str(int(number)), *words]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def _command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["evaluate", *words])
    return command.run("evaluate", evaluate_command.main, EvaluateConfig)


def _content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.*")}


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, INTERRUPTED), (signal.SIGTERM, -signal.SIGTERM), (signal.SIGKILL, -9)],
)
def test_the_same_command_goes_on_after_a_stop(
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
    code: int,
) -> None:
    stopped = _stop([*words, "out=stopped"], number)
    assert stopped.returncode == code
    assert sorted(_content(Path("stopped"))) == [
        "unfinished/.swarmjax.json",
        "unfinished/cell0.npz",
        "unfinished/evaluation.json",
    ]
    if number == signal.SIGINT:
        assert stopped.stderr == (
            "swarmjax.evaluate: interrupted, 1 cell is in stopped/unfinished, and the same command "
            "continues with the rest.\n"
        )
    judged, run = [], evaluate_trials.run

    def spy(config: EvaluateConfig, chosen: Any, *rest: Any) -> Iterator[Any]:
        judged.extend(cell.name for cell in chosen)
        return run(config, chosen, *rest)

    monkeypatch.setattr(evaluate_trials, "run", spy)
    assert _command(monkeypatch, *words, "out=stopped") == 0
    assert judged == ["two"]
    assert "1 of 2 cells were judged before" in capsys.readouterr().out
    assert _command(monkeypatch, *words, "out=whole") == 0
    whole = _content(Path("whole"))
    made = [".swarmjax.json", "levels.csv", "measures.png", "result.json", "times.png"]
    assert sorted(whole) == made
    assert _content(Path("stopped")) == whole


def test_a_file_alone_goes_on_too(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    _stop([*words, "out=stopped.json"])
    assert Path("stopped.json.unfinished/cell0.npz").exists()
    # The number of processes changes no result, so it may differ when an evaluation resumes.
    assert _command(monkeypatch, *words, "workers=2", "out=stopped.json") == 0
    assert _command(monkeypatch, *words, "out=whole.json") == 0
    assert Path("stopped.json").read_bytes() == Path("whole.json").read_bytes()
    assert not list(Path().glob("*unfinished*"))


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (["steps=61"], "cells.one.steps"),
        (["action=mean"], "cells.one.action"),
        (["policy=other.npz"], "policies"),
        (["suite=other.npz"], "cells.two.levels"),
    ],
)
def test_another_evaluation_is_refused_where_one_was_stopped(
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: list[str],
    key: str,
) -> None:
    _stop([*words, "out=stopped"])
    before = _content(Path("stopped"))
    steering.write(Path("other.npz"), drive=steering.STAY)
    _suite(Path("other_suite.npz"), seed=1000003)
    change = ["suite=other_suite.npz" if word == "suite=other.npz" else word for word in change]
    assert _command(monkeypatch, *words, *change, "out=stopped") == USER_ERROR
    printed = capsys.readouterr()
    assert printed.err == (
        "swarmjax.evaluate: error: out has stopped/unfinished, from an unfinished evaluation "
        f"that differs from this one in {key}: repeat its command, give another out, or remove "
        "that folder.\n"
    )
    assert _content(Path("stopped")) == before


def test_a_damaged_cell_is_refused_in_one_sentence(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _stop([*words, "out=stopped"])
    Path("stopped/unfinished/cell0.npz").write_bytes(b"PK")
    assert _command(monkeypatch, *words, "out=stopped") == USER_ERROR
    error = capsys.readouterr().err
    assert error.startswith(
        "swarmjax.evaluate: error: stopped/unfinished/cell0.npz cannot be read: "
    )
    assert error.count("\n") == 1


# --- step limits


@pytest.mark.parametrize(
    ("typed", "limits"), [([], [1500, 70]), (["steps=40"], [40, 40])], ids=["cell", "typed"]
)
@pytest.mark.slow
def test_a_cell_has_a_step_limit_of_its_own(
    words: list[str], monkeypatch: pytest.MonkeyPatch, typed: list[str], limits: list[int]
) -> None:
    """Robots that stay at their start use up the whole step limit."""
    steering.write(Path("policy.npz"), drive=steering.STAY)
    _suite(Path("tiny.npz"), steps=70)
    few = [word for word in words if not word.startswith("steps=")]
    assert _command(monkeypatch, *few, *typed, "out=out") == 0
    result = json.loads(Path("out/result.json").read_text())
    assert result["steps"] == (40 if typed else 1500)
    assert [cell["steps"] for cell in result["cells"]] == limits
    with Path("out/levels.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name, limit in zip(("one", "two"), limits, strict=True):
        times = {float(row["episode_time_s"]) for row in rows if row["cell"] == name}
        assert list(times) == pytest.approx([limit * steering.STEP])


def test_a_step_limit_is_nothing_that_levels_depend_on(tmp_path: Path) -> None:
    plain, limited = (
        cells.read(_suite(tmp_path / f"{steps}.npz", steps=steps)) for steps in (None, 3000)
    )
    assert [cell.steps for cell in plain.cells] == [None, None]
    assert [cell.steps for cell in limited.cells] == [None, 3000]
    assert [cell.digest for cell in plain.cells] == [cell.digest for cell in limited.cells]
