"""Tests the command that judges policies: figures by hand, files, and refused settings."""

import csv
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import steering
from steering import SPEED, STAY, STEP

from swarmjax import command, life, policy
from swarmjax.config import build, files, to_dict
from swarmjax.evaluate import __main__ as evaluate_command
from swarmjax.evaluate import cells, statistics
from swarmjax.evaluate import summary as evaluate_summary
from swarmjax.evaluate import table as evaluate_table
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import evaluate, list_files
from swarmjax.evaluate.measures import MEASURES
from swarmjax.evaluate.suite_config import read_suite
from swarmjax.evaluate.trials import Trial
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import observation
from swarmjax.task.config import TaskConfig
from swarmjax.task.stage_config import StageConfig


def _stage(robots: int, side: float = 1.0, obstacles: int = 0) -> StageConfig:
    return StageConfig(name="test", robots=robots, side=side, obstacles=obstacles)


def _config(path: Path, **rest: Any) -> EvaluateConfig:
    """Returns settings with one process and the planar body, which is the faster body."""
    plain = {"robot": RobotConfig(), "workers": 1} | rest
    return EvaluateConfig(policy=str(path), **plain)


def _measures(settings: EvaluateConfig) -> dict[str, Any]:
    return evaluate(settings).result["cells"][0]["measures"]


def test_a_result_does_not_depend_on_batches_and_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = steering.write(tmp_path / "policy.npz")
    found = []
    for workers, batch in ((1, 64), (1, 2), (2, 3)):
        monkeypatch.setattr(evaluate_trials, "BATCH", batch)
        settings = _config(path, stage=_stage(2, 0.7, 1), steps=120, episodes=7, workers=workers)
        told: list[int] = []
        entrants = evaluate_trials.read_policies([str(path)])
        (trial,) = evaluate_trials.run(settings, cells.load(settings).cells, entrants, told.append)
        assert sum(told) == 7
        found.append(trial)
    for other in found[1:]:
        np.testing.assert_array_equal(other.shortest, found[0].shortest)
        for name, table in other.measures.items():
            np.testing.assert_array_equal(table, found[0].measures[name], err_msg=name)
    assert found[0].measures["targets_reached"].mean() > 0.0
    assert list(found[0].measures) == list(MEASURES)


@pytest.mark.parametrize("side", [0.5, 0.7])
def test_steering_to_the_target_reaches_it_in_empty_arenas(tmp_path: Path, side: float) -> None:
    path = steering.write(tmp_path / "policy.npz")
    found = _measures(_config(path, stage=_stage(2, side), episodes=40, steps=400))
    assert found["targets_reached"]["mean"] >= 0.95  # Only another robot can be in the way.
    # The bound is the time for the arena's diagonal at full speed and for half a turn at 3.14
    # rad/s, plus 1 s, plus a share of 0.05 of robots that take the whole episode.
    late = 0.05 * 400 * STEP
    assert 0.0 < found["time_to_reach_s"]["mean"] < side * math.sqrt(2) / SPEED + 1.0 + 1.0 + late
    assert 0.5 < found["spl"]["mean"] <= found["targets_reached"]["mean"]


def test_standing_still_reaches_nothing(tmp_path: Path) -> None:
    path = steering.write(tmp_path / "policy.npz", STAY)
    settings = _config(path, stage=_stage(2), episodes=5, steps=160)
    found = {name: each["mean"] for name, each in _measures(settings).items()}
    for name in ("targets_reached", "all_reached", "spl", "contacts_per_robot", "contact_s_wall"):
        assert found[name] == 0.0
    # 160 control steps are 5.12 s, which is long enough for a deadlock and ends in a time-out.
    assert found["deadlocks"] == found["time_outs"] == 1.0
    assert found["episode_time_s"] == pytest.approx(160 * STEP)
    assert found["time_to_reach_s"] == pytest.approx(160 * STEP)


# --- intervals


def test_one_policy_is_judged_over_levels_and_several_over_policies_too() -> None:
    tables = {"targets_reached": np.random.default_rng(0).random((3, 40))}
    cases = ((1, "tasks"), (2, "tasks"), (3, "runs_and_tasks"))
    for policies, draw in cases:
        table = tables["targets_reached"][:policies]
        found = evaluate_summary.summarize({"targets_reached": table})["targets_reached"]
        expected: Any = statistics.bootstrap(table, np.mean, draw=draw)
        assert found["mean"] == pytest.approx(table.mean())
        assert found["mean_interval"] == [expected.low, expected.high]
        assert found["iqm"] == pytest.approx(statistics.iqm(table))


def test_the_worst_levels_are_those_that_are_bad() -> None:
    values = np.arange(100.0)[None]
    found = evaluate_summary.summarize({"targets_reached": values, "contacts_per_robot": values})
    assert found["targets_reached"]["cvar"] == pytest.approx(np.mean([0, 1, 2, 3, 4]))
    assert found["contacts_per_robot"]["cvar"] == pytest.approx(np.mean([95, 96, 97, 98, 99]))


def test_two_levels_have_no_interval() -> None:
    found = evaluate_summary.summarize({"spl": np.array([[0.2, 0.4]])})["spl"]
    assert found["mean"] == pytest.approx(0.3)
    assert found["mean_interval"] is None


def test_a_comparison_is_paired_by_level() -> None:
    a = {"targets_reached": np.random.default_rng(0).random((1, 50))}
    b = {"targets_reached": a["targets_reached"] - 0.25}
    found = evaluate_summary.compare(a, b)["targets_reached"]
    assert found["difference"] == pytest.approx(-0.25)
    assert found["difference_interval"] == pytest.approx([-0.25, -0.25])
    assert (found["improvement"], found["improvement_interval"]) == (0.0, [0.0, 0.0])
    contacts = evaluate_summary.compare(
        {"contacts_per_robot": a["targets_reached"]}, {"contacts_per_robot": b["targets_reached"]}
    )["contacts_per_robot"]
    assert contacts["improvement"] == 1.0  # fewer contacts are better


def test_strata_of_two_levels_have_no_interval() -> None:
    """A resample of a stratum of one level never changes, so the interval would have no width."""
    table = {"spl": np.random.default_rng(1).random((1, 10))}
    for strata, there in (([5, 5], True), ([7, 3], True), ([8, 2], False), ([1] * 10, False)):
        found = evaluate_summary.summarize(table, strata)["spl"]
        assert (found["mean_interval"] is not None) == there
        found = evaluate_summary.compare(table, table, strata)["spl"]
        assert ("difference" in found) == there


def _trial(name: str, *, seed: int = 1_000_000, first: int = 0, **stage: Any) -> Trial:
    """Returns a trial of one policy on ten levels, with random path efficiencies."""
    numbers = np.arange(first, first + 10)
    plain = StageConfig(**({"name": name, "robots": 2, "side": 1.0} | stage))
    levels: Any = None
    cell = Cell(name, plain, None, seed, numbers, levels)
    found = {"spl": np.random.default_rng(first).random((1, 10))}
    return Trial(cell, np.ones((10, 2)), found)


@pytest.mark.parametrize(
    ("other", "shared"),
    [
        ({}, True),
        ({"first": 9}, True),  # one level is shared
        ({"first": 10}, False),
        ({"seed": 1_000_001}, False),
        ({"side": 1.1}, False),
    ],
)
def test_cells_that_share_levels_are_not_pooled(
    monkeypatch: pytest.MonkeyPatch, other: dict[str, Any], shared: bool
) -> None:
    monkeypatch.setattr(evaluate_summary, "about_cell", lambda *_: {})
    trials = [_trial("a"), _trial("b", seed=1_000_002), _trial("c", **other)]
    settings = EvaluateConfig(policy="", stage=_stage(2))
    one = evaluate_summary.result(settings, "x", [[]], trials)["pooled"]
    twice = [each._replace(measures={"spl": each.measures["spl"].repeat(2, 0)}) for each in trials]
    two = evaluate_summary.result(settings, "x", [[], []], twice)["pooled"]
    if shared:
        assert one is two is None
        return
    assert one["episodes"] == two["episodes"] == 30
    mean = np.mean([trial.measures["spl"] for trial in trials])
    assert one["measures"]["spl"]["mean"] == pytest.approx(mean)
    assert two["measures"]["spl"]["a"] == pytest.approx(mean)


def test_long_lists_of_files_are_taken_apart() -> None:
    names = [f"policy{i}.npz" for i in range(1000)]  # joined, too long for a path
    assert list_files("policy", ",".join(names)) == names


# --- the command


def _plain(section: Any) -> dict[str, Any]:
    """Returns a section of the configuration as plain JSON data."""
    return json.loads(json.dumps(to_dict(section)))


def _command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["evaluate", *words])
    return command.run("evaluate", evaluate_command.main, EvaluateConfig)


def test_the_command_writes_the_result_and_prints_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = steering.write(tmp_path / "policy.npz"), tmp_path / "new" / "result.json"
    words = (f"policy={path}", "stage=s1", "episodes=3", "steps=20", "seed=5", "workers=1")
    rules = ("robot.mass=0.2", "task.target_radius=0.06", "realism.speed_noise=0.01")
    assert _command(monkeypatch, *words, *rules, f"out={out}") == 0
    result = json.loads(out.read_text())
    assert [path.name for path in out.parent.iterdir()] == ["result.json"]
    assert {key: result[key] for key in ("suite", "engine", "steps", "substeps", "pooled")} == {
        "suite": None,
        "engine": "c",
        "steps": 20,
        "substeps": 4,  # of the wheeled robot in this engine
        "pooled": None,
    }
    assert result["robot"] == _plain(RobotConfig(body="wheeled", hull_friction=1.0, mass=0.2))
    assert result["task"] == _plain(TaskConfig(target_radius=0.06))
    assert result["cells"][0]["realism"] == _plain(RealismConfig(speed_noise=0.01))
    assert result["policies"] == [{"path": str(path), "digest": policy.load(path).digest}]
    assert result["versions"]["mujoco"] == mujoco.__version__
    (cell,) = result["cells"]
    assert (cell["cell"], cell["episodes"], cell["seed"], cell["unreachable"]) == ("s1", 3, 5, 0)
    printed = capsys.readouterr()
    row = next(line for line in printed.out.splitlines() if "targets reached, %" in line)
    assert f"{100 * cell['measures']['targets_reached']['mean']:.1f}" in row.split()
    assert f"{path.name} on s1, 3 episodes" in printed.out  # a long path loses its beginning
    assert "\x1b" not in printed.out  # no colours, since the output is not a terminal
    assert printed.err == ""


def test_no_line_of_an_evaluation_is_too_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = steering.write(tmp_path / ("long" * 40) / "policy.npz")
    assert _command(monkeypatch, f"policy={path}", "stage=s1", "episodes=3", "steps=2") == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 120


def test_no_line_about_a_suite_is_too_long(
    tmp_path: Path, suite: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = steering.write(tmp_path / "policy.npz")
    result = evaluate(_config(path, stage=_stage(2), suite=str(suite), steps=2)).result
    for i, cell in enumerate(result["cells"]):
        cell["cell"] = f"a_cell_with_a_long_name_{i}"
        for figures in cell["measures"].values():
            figures |= {"mean": 0.99996, "mean_interval": [0.99996, 0.99996]}
    evaluate_table.show(evaluate_table.console(), result)
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 120
    assert printed.count("100.0 [100.0, 100.0]") == 4  # no number is cut


def test_an_evaluation_without_a_terminal_says_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(life, "EVERY_S", 0.01)
    path = steering.write(tmp_path / "policy.npz")
    assert _command(monkeypatch, f"policy={path}", "stage=s1", "episodes=3", "steps=300") == 0
    time.sleep(0.5)  # until the filter has written all
    assert "of 3 episodes after" in capfd.readouterr().err


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    """Writes the levels of a suite of two small cells; returns the path of the file."""
    file = tmp_path / "tiny.yaml"
    file.write_text(
        "name: tiny\ncells:\n"
        "  - {name: one, stage: s1, levels: 4, seed: 1000001}\n"
        "  - {name: two, stage: s3, levels: 5, seed: 1000002, realism: webots}\n"
    )
    drawn = [cells.draw_cell(each) for each in read_suite(str(file)).cells]
    cells.write(tmp_path / "tiny.npz", cells.Suite("tiny", tuple(drawn)))
    return tmp_path / "tiny.npz"


def test_a_suite_and_several_policies_fill_a_folder(
    tmp_path: Path, suite: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for i in range(3):
        steering.write(tmp_path / f"seed{i}.npz", drive=steering.STEER if i else STAY)
    out = tmp_path / "out"
    words = (f"policy={tmp_path}/seed*.npz", f"suite={suite}", "steps=40", "workers=1")
    assert _command(monkeypatch, *words, f"out={out}") == 0
    result = json.loads((out / "result.json").read_text())
    assert result["suite"] == "tiny"
    assert [each["path"][-9:] for each in result["policies"]] == [f"seed{i}.npz" for i in range(3)]
    assert [cell["cell"] for cell in result["cells"]] == ["one", "two"]
    assert [cell["realism"]["name"] for cell in result["cells"]] == ["ideal", "webots"]
    preset = build(RealismConfig, files.read_choice("realism", "webots"))
    assert result["cells"][1]["realism"] == _plain(preset)
    with (out / "levels.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * (4 + 5)
    for cell in result["cells"]:
        mine = [float(row["spl"]) for row in rows if row["cell"] == cell["cell"]]
        assert cell["measures"]["spl"]["mean"] == pytest.approx(np.mean(mine))
    every = [float(row["targets_reached"]) for row in rows]
    assert result["pooled"]["measures"]["targets_reached"]["mean"] == pytest.approx(np.mean(every))
    printed = capsys.readouterr().out
    assert "seed0.npz and 2 more on suite tiny, 9 episodes" in printed
    rows = printed.partition("stuck, %")[2].splitlines()[1:]
    assert [line.split()[0] for line in rows] == ["one", "two", "all"]


def test_a_comparison_is_written_and_shown(
    tmp_path: Path, suite: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = steering.write(tmp_path / "a.npz", STAY), steering.write(tmp_path / "b.npz")
    out = tmp_path / "out"
    words = (f"compare={a},{b}", f"suite={suite}", "steps=100", "workers=1", f"out={out}")
    assert _command(monkeypatch, *words) == 0
    result = json.loads((out / "result.json").read_text())
    assert [[each["path"] for each in side] for side in result["compared"]] == [[str(a)], [str(b)]]
    found = result["cells"][0]["measures"]["targets_reached"]
    assert found["a"] == 0.0
    assert found["difference"] == pytest.approx(found["b"]) != 0.0
    assert 0.5 < found["improvement"] <= 1.0
    with (out / "levels.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["policy"] for row in rows} == {str(a), str(b)}
    means = [float(r["targets_reached"]) for r in rows if r["policy"] == str(b)]
    assert result["pooled"]["measures"]["targets_reached"]["b"] == pytest.approx(np.mean(means))
    printed = capsys.readouterr().out
    assert f"{a} against {b} on suite tiny, 9 episodes" in " ".join(printed.split())
    heads = [line.split(" levels")[0].strip() for line in printed.splitlines() if " levels" in line]
    assert heads == ["one, 4", "two, 5", "all, 9"]
    assert result["pooled"]["episodes"] == 9
    last = [line for line in printed.splitlines() if "targets reached, %" in line][-1]
    assert f"{100 * np.mean(means):.1f}" in last.split()


def test_a_suite_that_is_not_pooled_has_no_row_of_all(
    tmp_path: Path, suite: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = cells.read(suite).cells[0]
    again = drawn._replace(name="again", realism="webots")
    cells.write(suite, cells.Suite("tiny", (drawn, again)))
    path = steering.write(tmp_path / "p.npz")
    words = (f"suite={suite}", "steps=2", "workers=1")
    assert _command(monkeypatch, f"policy={path}", *words) == 0
    printed = capsys.readouterr().out
    rows = printed.partition("stuck, %")[2].splitlines()[1:]
    assert [line.split()[0] for line in rows] == ["one", "again"]
    assert _command(monkeypatch, f"compare={path},{path}", *words) == 0
    printed = capsys.readouterr().out
    heads = [line.split(" levels")[0].strip() for line in printed.splitlines() if " levels" in line]
    assert heads == ["one, 4", "again, 4"]


def test_unreachable_targets_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        evaluate_trials.shortest_path, "shortest", lambda side, start, *_: _lost(start)
    )
    path = steering.write(tmp_path / "policy.npz")
    words = (f"policy={path}", "stage=s1", "episodes=3", "steps=2", "workers=1")
    assert _command(monkeypatch, *words, f"out={tmp_path}/r.json") == 0
    assert json.loads((tmp_path / "r.json").read_text())["cells"][0]["unreachable"] == 2
    printed = capsys.readouterr().out
    assert "2 of 3 levels of s1 have a target that no robot can reach." in printed


def _lost(start: np.ndarray) -> np.ndarray:
    """Returns lengths of shortest paths; in two of three levels one robot has no path."""
    lengths = np.ones(start.shape[:-1])
    lengths[1:, 0] = np.inf
    return lengths


@pytest.fixture
def wrong(tmp_path: Path) -> None:
    """Writes a policy that fits, and three policies that do not."""
    steering.write(tmp_path / "policy.npz")
    steering.write(tmp_path / "three.npz", learners=3, policy="independent")
    layout = observation.describe("metric") | {"limit": 10.0}
    names = ["target_angle" if name == "target_bearing" else name for name in observation.NAMES]
    steering.write(tmp_path / "other.npz", observation=layout | {"names": names})
    scale = [2.0] * observation.SIZE
    steering.write(tmp_path / "scaled.npz", observation=layout | {"scale": scale})


@pytest.mark.usefixtures("wrong")
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["policy=none.npz"], "none.npz "),
        (["policy=no*.npz"], "policy is 'no*.npz', but no file matches 'no*.npz'"),
        (["policy=policy.npz,p*.npz"], "policy is "),
        (
            ["policy=policy.npz", "stage=s7"],
            "stage is 's7': give s6 (the most similar name) or one of ",
        ),
        ([], "policy is null and compare is null: give exactly one of the two"),
        (["compare=policy.npz"], "compare is 'policy.npz': give two files"),
        (
            ["policy=policy.npz", "out=policy.npz/result.json"],
            "out is policy.npz/result.json, which cannot be written: ",
        ),
        (
            ["policy=policy.npz", "out=policy.npz"],
            "out is policy.npz, which cannot be written: ",
        ),
        (
            ["policy=three.npz", "stage=s6"],
            "three.npz holds a network for each of 3 robots, but stage s6 has 5 robots: give a "
            "shared policy, or a stage with 1 to 3 robots.",
        ),
        (
            ["policy=other.npz", "stage=s1"],
            "other.npz was trained with observations that this robot does not have: the "
            f"policy's meta.observation.names is {observation.NAMES[0]}, ",
        ),
        (
            ["policy=scaled.npz", "stage=s1"],
            "scaled.npz was trained with observations that this robot does not have: the "
            "policy's meta.observation.scale is 2.0, ",
        ),
        (
            ["policy=policy.npz", "suite=stage"],
            "suite is 'stage': give stages (the most similar name) or one of ",
        ),
        (
            ["policy=policy.npz", "suite=no.yaml"],
            "suite is 'no.yaml', but this file does not exist: check the path.",
        ),
        (["policy=policy.npz", "suite=no.npz"], "suite no.npz cannot be read: "),
        (
            ["policy=policy.npz", "suite=stages", "robot.hull_radius=0.04"],
            "robot.hull_radius is 0.04, but the levels of suites are made for hulls of at most "
            "0.037 m: give at most 0.037.",
        ),
        (
            ["policy=policy.npz", "suite=stages", "task.target_radius=0.06"],
            "task.target_radius is 0.06, but the levels of suites are made for 0.05 m: give 0.05.",
        ),
    ],
)
def test_the_command_refuses_in_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    sentence: str,
) -> None:
    # Sentences shorten long values such as paths, so the paths here are relative.
    monkeypatch.chdir(tmp_path)
    short = [] if any(word.startswith("suite=") for word in words) else ["episodes=1"]
    assert _command(monkeypatch, *words, "workers=1", *short) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"swarmjax.evaluate: error: {sentence}")
    assert printed.err.count("\n") == 1


@pytest.mark.usefixtures("wrong")
def test_a_comparison_takes_as_many_policies_of_either_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert _command(monkeypatch, "compare=policy.npz,*e*.npz", "stage=s1", "episodes=1") == 2
    printed = capsys.readouterr().err
    assert "compare is 'policy.npz,*e*.npz', which names 1 and 3 policies: give as many " in printed
    assert printed.count("\n") == 1
