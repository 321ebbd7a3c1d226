"""Tests cells with a step limit of their own."""

import csv
import json
import sys
from pathlib import Path

import pytest
import steering

from swarmjax import command
from swarmjax.evaluate import __main__ as evaluate_command
from swarmjax.evaluate import cells
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.suite_config import read_suite


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


def _command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["evaluate", *words])
    return command.run("evaluate", evaluate_command.main, EvaluateConfig)


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
