"""Tests that a run ends once every seed has the success `run.stop_at` on the last stage."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swarmjax import train
from swarmjax.config import show, to_dict
from swarmjax.run import checkpoint, results
from swarmjax.run.checkpoint import digest
from swarmjax.run.directory import LOCK
from swarmjax.run.load_settings import load_resume, load_train
from swarmjax.run.run import Run
from swarmjax.run.settings import RunConfig, TrainConfig
from swarmjax.training import program as programs

COHORT, UPDATES = 3, 18
# Some robots drift into the wide targets, which begin near them. A cohort is 24 / 8 updates.
WORDS = [
    "stage=s1",
    "stage.distance=[0.12,0.14]",
    "task.target_radius=0.1",
    "task.step_limit=24",
    "algo.rollout_length=8",
    "algo.num_minibatches=2",
    "algo.hidden_sizes=[8]",
    "sim.impl=jax",
    "arenas=8",
    "seeds=2",
    f"budget={8 * 8 * UPDATES}",
    "run.tensorboard=false",
]


def _train(run: Path, *words: str) -> Path:
    assert train.main([*WORDS, f"run.dir={run}", *words]) == 0
    return run


def _rows(run: Path) -> list[dict]:
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(line).items() if k != "train_s"} for line in lines]


def _summary(run: Path) -> dict:
    return json.loads((run / "summary.json").read_text())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _train(tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture(scope="module")
def goal(whole: Path) -> float:
    """Returns a success that both seeds have at the end of some cohort before the last."""
    return max(_lowest(whole)[COHORT - 1 : -1 : COHORT])


@pytest.fixture(scope="module")
def end(whole: Path, goal: float) -> int:
    """Returns the first end of a cohort at which both seeds have the success."""
    lowest = _lowest(whole)
    return next(n for n in range(COHORT, UPDATES, COHORT) if lowest[n - 1] >= goal > 0.0)


def _lowest(run: Path) -> list[float]:
    """Returns the lower success of the two seeds after each update."""
    shares = [row["success_by_stage"][0] or 0.0 for row in _rows(run)]
    return [min(both) for both in zip(shares[::2], shares[1::2], strict=True)]


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory, goal: float) -> Path:
    return _train(tmp_path_factory.mktemp("stopped") / "run", f"run.stop_at={goal}", "run.chunk=7")


def test_a_run_stops_at_the_first_whole_cohort_of_this_success(
    stopped: Path, whole: Path, goal: float, end: int
) -> None:
    assert _rows(stopped) == _rows(whole)[: 2 * end]
    assert checkpoint.find(stopped).update == end
    summary = _summary(stopped)
    assert (summary["updates"], summary["budget_spent"]) == (end, False)
    assert summary["stopped_at"] == goal
    assert (stopped / "policy-seed1.npz").exists()
    assert _summary(whole)["stopped_at"] is None


@pytest.mark.parametrize("chunk", ["1", "auto"])
@pytest.mark.slow
def test_chunks_of_any_size_stop_at_the_same_update(
    chunk: str, stopped: Path, goal: float, tmp_path: Path
) -> None:
    run = _train(tmp_path / "run", f"run.stop_at={goal}", f"run.chunk={chunk}")
    assert _rows(run) == _rows(stopped)
    assert digest(checkpoint.find(run)[0]) == digest(checkpoint.find(stopped)[0])


def _contents(run: Path) -> dict[Path, tuple[bytes, int]]:
    files = [path for path in run.rglob("*") if path.is_file() and path.name != LOCK]
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


@pytest.mark.parametrize("words", [[], ["budget=1e6"]])
def test_such_a_run_that_is_resumed_says_so_and_stays_as_it_is(
    words: list[str],
    stopped: Path,
    goal: float,
    end: int,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Run, "compile", lambda _: pytest.fail("nothing to compile"))
    before = _contents(stopped)
    assert train.main([f"resume={stopped}", *words]) == 0
    said = " ".join(capsys.readouterr().out.split())  # long lines are broken
    reached = f"every seed has reached run.stop_at={show(goal)}"
    more = "for more, give a larger one, or run.stop_at=null"
    assert f"nothing left to train: {reached}; {more}" in said
    updates = 15_625 if words else UPDATES
    assert (
        f"done after update {end} of {updates:,}, as {reached}; evaluate each of 2 policies" in said
    )
    assert _contents(stopped) == before


def test_such_a_run_gets_the_summary_that_it_lacks(
    stopped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Run, "compile", lambda _: pytest.fail("nothing to compile"))
    copied = Path(shutil.copytree(stopped, tmp_path / "copied"))
    (copied / "summary.json").unlink()
    assert train.main([f"resume={copied}"]) == 0
    assert _summary(copied) == _summary(stopped) | {"compile_s": 0.0}


def test_such_a_run_goes_on_to_its_budget_without_the_key(
    stopped: Path, whole: Path, tmp_path: Path
) -> None:
    copied = Path(shutil.copytree(stopped, tmp_path / "copied"))
    assert train.main([f"resume={copied}", "run.stop_at=null"]) == 0
    assert _rows(copied) == _rows(whole)
    assert digest(checkpoint.find(copied)[0]) == digest(checkpoint.find(whole)[0])
    summary = _summary(copied)
    assert (summary["budget_spent"], summary["stopped_at"]) == (True, None)


def test_a_resumed_run_keeps_the_key() -> None:
    stored = to_dict(load_train(["run.stop_at=0.9"]))
    assert load_resume(stored, []).run.stop_at == 0.9
    assert load_resume(stored, ["run.stop_at=0.95"]).run.stop_at == 0.95


@pytest.mark.parametrize(
    ("goal", "success", "by_seed", "reached"),
    [
        (0.95, "targets", [0.95, 1.0], True),  # 0.95 in float32 is a little less
        (0.95, "targets", [1.0, 0.9375], False),
        (0.95, "targets", [1.0, None], False),
        (0.95, "all", [1.0, 1.0], False),
        (None, "targets", [1.0, 1.0], False),
        (0.95, "targets", [], False),
    ],
)
def test_every_seed_must_have_the_success_on_the_last_stage(
    goal: float | None, success: str, by_seed: list[float | None], reached: bool
) -> None:
    settings = load_train([f"curriculum.success={success}"])
    settings = replace(settings, run=RunConfig(stop_at=goal))
    shares = [None if each is None else float(np.float32(each)) for each in by_seed]
    newest = [
        {
            "success_by_stage": [1.0, share],
            "complete_by_stage": [1.0, 0.5],
            "episodes_by_stage": [9, 64],  # half of the 128 arenas
        }
        for share in shares
    ]
    assert results.has_reached(settings, newest) is reached
    few = [row | {"episodes_by_stage": [99, 63]} for row in newest]
    assert not results.has_reached(settings, few)


def test_a_run_is_ended_by_the_end_of_a_cohort_only(tiny_config: TrainConfig) -> None:
    run = Run(replace(tiny_config, run=RunConfig(stop_at=0.5)))
    run.schedule = programs.schedule(tiny_config)
    cohort = int(run.schedule.cohort_updates)
    assert cohort > 1
    run._newest = [{"success_by_stage": [1.0], "episodes_by_stage": [100]}]
    ended = []
    for run.update in range(1, 2 * cohort + 1):
        ended.append(run._has_ended())
    assert ended == [update % cohort == 0 for update in range(1, 2 * cohort + 1)]
