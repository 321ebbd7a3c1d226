"""Tests the study of curricula on worlds: arms, points, and tables worked out by hand."""

import json
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
import pytest
from sentences import refusal

from benchmarks import key_value, worlds_study, worlds_table
from benchmarks.worlds_study import Arm, Study
from swarmjax import policy_file
from swarmjax.run.load_settings import load_train
from swarmjax.training import mesh
from swarmjax.training import program as programs


@pytest.mark.parametrize("arm", worlds_study.ARMS)
def test_arms_train_on_all_families_with_one_recipe(arm: Arm) -> None:
    config = worlds_study.load_arm(Study(), arm, [])
    assert len(config.stage) == 10
    assert (config.algo.memory, config.algo.critic) == ("gru", "state")
    assert config.task.neighbours.count == 4
    assert (config.seeds, config.budget) == (10, 80_000_000)


@pytest.mark.parametrize(
    ("without", "memory", "count", "critic"),
    [
        ("memory", "none", 4, "state"),
        ("messages", "gru", 0, "state"),
        ("state", "gru", 4, "observation"),
    ],
)
def test_a_part_can_be_left_out(without: Any, memory: str, count: int, critic: str) -> None:
    config = worlds_study.load_arm(Study(without=without), "adaptive", [])
    assert config.algo.memory == memory
    assert config.task.neighbours.count == count
    assert config.algo.critic == critic


def test_words_win_over_the_recipe() -> None:
    assert worlds_study.load_arm(Study(), "mixed", ["seeds=3"]).seeds == 3


def test_only_the_arm_without_curriculum_has_the_sizes_that_are_judged() -> None:
    hardest = worlds_study.load_arm(Study(), "hardest", []).stage[0]
    assert (hardest.level, hardest.width, hardest.depth) == ("trap", 0.3, 0.3)
    assert isinstance(worlds_study.load_arm(Study(), "random", []).stage[0].depth, tuple)


def test_a_size_that_is_no_range_is_kept(tmp_path: Path) -> None:
    stage = tmp_path / "deep.yaml"
    stage.write_text("{level: trap, robots: 1, side: 1.6, width: [0.3, 0.8], depth: 0.7}")
    hardest = worlds_study.load_arm(Study(without="messages"), "hardest", [f"stage={stage}"])
    assert (hardest.stage[0].width, hardest.stage[0].depth) == (0.3, 0.7)


def test_the_last_point_is_the_end() -> None:
    words = ["budget=5e6", "arenas=8192"]  # 9 updates of 524,288 arena steps
    config = worlds_study.load_arm(Study(), "random", words)
    assert worlds_study.points(Study(points=3), config).tolist() == [3, 6, 9]
    assert refusal(worlds_study.points, Study(points=10), config) == (
        "points is 10, but the budget pays for 9 updates: give at most 9."
    )


def test_an_unknown_arm_is_refused() -> None:
    assert "arms is 'best': give hardest, random" in refusal(key_value.load, Study, ["arms=best"])


def test_the_policy_of_each_seed_is_written(tmp_path: Path) -> None:
    trained = load_train(["stage=s1", "seeds=2", "arenas=8"])
    program, schedule = programs.load(trained)
    learners = jax.jit(mesh.init(program))(schedule).learners
    worlds_study.write_policies(tmp_path / "arm", learners, trained, update=3)
    expected = learners.params["actor"]["mean"]["kernel"]
    for seed in range(2):
        path = tmp_path / "arm" / f"policy-seed{seed}.npz"
        assert policy_file.read_meta(path)["update"] == 3
        with np.load(path) as found:
            assert (found["actor/mean/kernel"] == expected[seed]).all()


def test_the_learners_that_were_judged_last_are_kept(capsys: pytest.CaptureFixture[str]) -> None:
    shares = {"a": {"all_reached": np.array([0.5])}, "b": {"all_reached": np.array([1.0])}}
    judge = worlds_study._ReportingJudge("random", lambda _: shares)
    for learners in ("first", "last"):
        assert judge(cast("Any", learners)) is shares
    assert judge.learners == "last"
    assert capsys.readouterr().err == 2 * "random: all robots arrive in 75.0 % of levels\n"


def _line(arm: str, seeds: list[int], trap: list[list[float]], fence: list[list[float]]) -> Any:
    return {
        "benchmark": "worlds_study",
        "arm": arm,
        "seeds": seeds,
        "levels": 4,
        "level_seed": 5,
        "steps": 9,
        "arena_steps": [100, 200],
        "judged": {
            "world_trap": {"all_reached": trap, "contacts_per_robot": [[0.5, 0.25]] * len(seeds)},
            "world_fence": {"all_reached": fence, "contacts_per_robot": [[0.5, 0.25]] * len(seeds)},
        },
    }


RANDOM = _line("random", [0, 1, 2], [[0.0, 0.0]] * 3, [[0.5, 0.8]] * 3)
BETTER = _line("adaptive", [0, 1, 2], [[0.5, 1.0]] * 3, [[0.7, 1.0]] * 3)
# Two of three seeds end above those of RANDOM (0.4), and one has a higher mean over both points
# (0.325).
MIXED = _line(
    "mixed", [0, 1, 2], [[0.0, 0.5], [0.0, 0.3], [0.2, 0.5]], [[0.0, 0.5], [0.5, 0.3], [0.3, 0.5]]
)


def _rows(*lines: Any) -> list[list[str]]:
    """Returns the cells of the table of arms."""
    table = worlds_table.arms_table(worlds_table.merge(lines)).splitlines()[2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in table]


def test_an_arm_has_its_own_results() -> None:
    _, row = _rows(BETTER, RANDOM)
    # The mean over the families rises from 0.6 to 1.0, and passes 0.9 after three quarters of the
    # steps between the two points, and 0.95 after seven eighths.
    assert row[:6] == [
        "adaptive",
        "1.000 [1.000, 1.000]",
        "1.8e2 [1.8e2, 1.8e2]",
        "1.9e2 [1.9e2, 1.9e2]",
        "1.000 [1.000, 1.000]",
        "0.250 [0.250, 0.250]",
    ]


def test_an_arm_that_never_gets_there_says_so() -> None:
    assert _rows(RANDOM)[0][2] == "never [never, never]"


def test_an_arm_is_compared_with_the_baseline() -> None:
    baseline, row = _rows(MIXED, RANDOM)
    assert baseline[6:] == ["-", "-"]
    assert [cell.split()[0] for cell in row[6:]] == ["0.667", "0.333"]


def test_families_are_compared() -> None:
    found = worlds_table.families_table(worlds_table.merge([BETTER, RANDOM])).splitlines()
    assert found == [
        "| family | random | adaptive |",
        "|---|--:|--:|",
        "| `trap` | 0.00 | 1.00 |",
        "| `fence` | 0.80 | 1.00 |",
    ]


def test_seeds_of_several_runs_are_put_together() -> None:
    more = _line("random", [3], [[1.0, 1.0]], [[1.0, 1.0]])
    found = worlds_table.merge([RANDOM, more])["random"]
    assert found["seeds"] == [0, 1, 2, 3]
    expected = np.array([[0.0, 0.8]] * 3 + [[1.0, 1.0]])
    assert (worlds_table.curves(found, "all_reached")[..., -1] == expected).all()


def test_a_seed_counts_once() -> None:
    assert refusal(worlds_table.merge, [RANDOM, RANDOM]) == (
        "arm random has seed 0 twice: leave one line out."
    )


def test_arms_are_judged_alike() -> None:
    assert refusal(worlds_table.merge, [RANDOM, BETTER | {"steps": 10}]) == (
        "arm adaptive has steps 10, but random has 9: compare lines of one study."
    )


def test_lines_of_other_benchmarks_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_text(json.dumps({"benchmark": "curriculum"}))
    assert "line 1 is not a line of benchmarks.worlds_study" in refusal(worlds_table.read, path)
    path.write_text(json.dumps({k: v for k, v in RANDOM.items() if k != "steps"}))
    assert "line 1 has no steps: it is damaged" in refusal(worlds_table.read, path)
