"""Tests `launch/sweep.py` in submitit's debug executor and with stand-ins for Slurm."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from swarmjax import command
from swarmjax.config import section
from swarmjax.run.settings import TrainConfig

# Submitit's debug executor leaves log files open, which raises these warnings.
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
SCRIPT = Path(__file__).parents[2] / "launch" / "sweep.py"
TINY = [
    "stage=s1",
    "algo.num_minibatches=2",
    "algo.hidden_sizes=[8]",
    "run.tensorboard=false",
    "budget=512",
]
GRID = ["grid.arenas=4,8", *TINY]


@pytest.fixture
def quick(sweep: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(sweep, "_TICK_S", 0)
    return sweep


def _stand_in(
    monkeypatch: pytest.MonkeyPatch, sweep: Any, codes: dict[str, list[int]]
) -> list[str]:
    """Replaces training by a stand-in that returns the given exit codes of each `arenas=N`.

    Returns a list to which the stand-in adds the `arenas=N` of each call.
    """
    asked = []

    def train(words: Sequence[str], _: str | None) -> int:
        (arenas,) = [word for word in words if word.startswith("arenas=")]
        asked.append(arenas)
        return codes[arenas].pop(0)

    monkeypatch.setattr(sweep, "train", train)
    return asked


@pytest.mark.slow
def test_a_grid_is_trained_and_tabled_and_not_trained_again(tmp_path: Path) -> None:
    folder = tmp_path / "grid"
    words = [sys.executable, str(SCRIPT), f"dir={folder}", "cluster=debug", *GRID]
    first = subprocess.run(words, capture_output=True, text=True, check=False)
    assert first.returncode == 0, first.stderr
    printed = first.stdout.splitlines()
    assert printed[0] == "2 cells, 0 of them done before"
    rows = [line.split() for line in printed if line.startswith(f"{folder}/")]
    assert [row[:6] for row in rows] == [
        [f"{folder}/arenas=4", "arenas=4", "s1", "4", "of", "4"],
        [f"{folder}/arenas=8", "arenas=8", "s1", "2", "of", "2"],
    ]
    found = json.loads((folder / "sweep.json").read_text())
    assert found["codes"] == {"arenas=4": 0, "arenas=8": 0}
    assert [cell["updates"] == cell["budget"] for cell in found["cells"]] == [True, True]

    jobs = {*(folder / "jobs").iterdir()}
    again = subprocess.check_output(words, text=True)
    assert again.startswith("2 cells, 2 of them done before\nruns ")
    assert {*(folder / "jobs").iterdir()} == jobs


def test_a_job_that_saves_is_submitted_again(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = _stand_in(monkeypatch, quick, {"arenas=4": [75, 75, 0], "arenas=8": [0]})
    assert quick.main([f"dir={tmp_path}", "cluster=debug", *GRID]) == 0
    assert sorted(asked) == ["arenas=4", "arenas=4", "arenas=4", "arenas=8"]


def test_a_job_is_submitted_so_many_times(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = _stand_in(monkeypatch, quick, {"arenas=4": [75] * 9, "arenas=8": [0]})
    assert quick.main([f"dir={tmp_path}", "cluster=debug", "tries=3", *GRID]) == 75
    assert asked.count("arenas=4") == 3
    assert json.loads((tmp_path / "sweep.json").read_text())["codes"]["arenas=4"] == 75


def test_a_job_that_fails_is_named_and_keeps_no_other_from_training(
    quick: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = _stand_in(monkeypatch, quick, {"arenas=4": [2], "arenas=8": [0]})
    assert quick.main([f"dir={tmp_path}", "cluster=debug", *GRID]) == 1
    assert asked == ["arenas=4", "arenas=8"]
    assert f"arenas=4: failed with code 2, see {tmp_path}/jobs/" in capsys.readouterr().out


class _Job:
    """A stand-in for a job that was killed (`dead`) or is still running."""

    def __init__(self, *, dead: bool) -> None:
        self.job_id, self.cancelled, self._dead = "7", False, dead
        self.paths = SimpleNamespace(stderr="log")

    def done(self) -> bool:
        return self._dead

    def cancel(self, check: bool) -> None:
        self.cancelled = not check

    def result(self) -> int:
        raise RuntimeError("killed")


def test_a_job_that_is_killed_has_failed(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quick, "submit", lambda *_, **__: _Job(dead=True))
    assert quick.main([f"dir={tmp_path}", "cluster=debug", *GRID]) == 1


def test_what_runs_is_cancelled_when_the_sweep_is_interrupted(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = []

    def submit(*_: object, **__: object) -> _Job:
        if len(jobs) == 2:
            raise KeyboardInterrupt
        jobs.append(_Job(dead=False))
        return jobs[-1]

    monkeypatch.setattr(quick, "submit", submit)
    words = [f"dir={tmp_path}", "cluster=debug", "at_once=3", *TINY, "grid.arenas=4,8,16"]
    with pytest.raises(KeyboardInterrupt):
        quick.main(words)
    assert [job.cancelled for job in jobs] == [True, True]


def test_an_interrupted_cell_interrupts_the_sweep(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = _stand_in(monkeypatch, quick, {"arenas=4": [130], "arenas=8": [0]})
    with pytest.raises(KeyboardInterrupt):
        quick.main([f"dir={tmp_path}", "cluster=debug", *GRID])
    assert asked == ["arenas=4"]


def test_training_that_is_refused_or_breaks_is_an_exit_code(
    sweep: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep.train(["nonsense"], None) == 2
    assert capsys.readouterr().err == (
        "swarmjax.train: error: 'nonsense' is not a setting: give key=value.\n"
    )
    monkeypatch.setattr("swarmjax.train.main", lambda _: 1 // 0)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    assert sweep.train([], "5") == 1
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "5"
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_a_cell_waits_while_slurm_takes_no_more_jobs(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = [_Job(dead=True), None, _Job(dead=True)]
    asked = []

    def submit(_: object, __: object, *, is_first: bool) -> _Job | None:
        asked.append(is_first)
        return answers.pop(0)

    monkeypatch.setattr(quick, "submit", submit)
    quick.main([f"dir={tmp_path}", "cluster=debug", "at_once=2", *GRID])
    assert asked == [True, False, True]


def test_a_refusal_of_slurm_is_one_sentence(
    sweep: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("sbatch", "srun"):
        (tmp_path / name).write_text("#!/bin/sh\necho 'sbatch: error: too many jobs' >&2\nexit 1\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    settings, (cell,) = sweep.parse([f"dir={tmp_path}/grid", "grid.arenas=8", *TINY])
    assert sweep.submit(cell, settings, is_first=False) is None
    with pytest.raises(
        section.ConfigError, match=r"^cluster is slurm, but it takes no job: .*many"
    ):
        sweep.submit(cell, settings)


def test_slurm_is_asked_for_devices_and_time_to_save(
    sweep: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, line in {"sbatch": f"cp $1 {tmp_path}/asked; echo job 17", "srun": "exit 1"}.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    words = ["minutes=90", "cpus=3", "devices=2", "grid.arenas=8", *TINY]
    settings, (cell,) = sweep.parse([f"dir={tmp_path}/grid", *words])
    assert sweep.submit(cell, settings).job_id == "17"
    lines = (tmp_path / "asked").read_text().splitlines()
    asked = {line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH ")}
    assert asked >= {
        "--gpus-per-node=2",
        "--cpus-per-task=3",
        "--time=90",
        "--signal=USR2@180",
        "--job-name=swarmjax",
    }


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["grid.arenas=4,8"], "dir is missing and has no default: give it a value."),
        (["dir=", "grid.arenas=4,8"], "dir is '': give text."),
        (["dir=x", "cluster=lokal"], "cluster is 'lokal': give slurm, local or debug."),
        (["dir=x", "tries=0"], "tries is 0: give 1 to 1000."),
        (["dir=x"], "the grid is empty: give values, as in grid.algo.epochs=1,2."),
        (["dir=x", *GRID], "cluster is slurm, but there is no sbatch on the PATH: start the sweep"),
        (["dir=x", "arena=4", *GRID], "arena is not a key: did you mean arenas?"),
        (["dir=file/x", "cluster=local", *GRID], "file/x cannot be used: Not a directory."),
        (["dir=x", "cluster=debug", "nonsense"], "'nonsense' is not a setting: give key=value."),
    ],
)
def test_errors_are_one_sentence(
    words: list[str],
    sentence: str,
    sweep: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["sweep.py", *words])
    assert command.run("sweep", sweep.main, sweep.SweepConfig) == 2
    found = capsys.readouterr().err
    assert found.startswith(f"swarmjax.sweep: error: {sentence}")
    assert found.count("\n") == 1
    assert not Path("x").exists()


def test_a_sweep_without_submitit_says_how_to_install_it(
    sweep: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(section.ConfigError, match=r"^submitit is missing: install it with uv sync"):
        sweep.main([f"dir={tmp_path}", "cluster=local", *GRID])


def test_the_script_names_itself_by_its_path() -> None:
    python, root = sys.executable, SCRIPT.parents[1]
    words = ["launch/sweep.py", "dir=x", "cluster=debug"]
    done = subprocess.run([python, *words], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("launch/sweep.py: error: the grid is empty")
    told = subprocess.check_output([python, "launch/sweep.py", "--help"], cwd=root, text=True)
    assert told.startswith("usage: python launch/sweep.py key=value ...\n")


def test_no_key_of_the_sweep_is_one_of_training(sweep: Any) -> None:
    assert not {*section.names(sweep.SweepConfig)} & {*section.names(TrainConfig)}
