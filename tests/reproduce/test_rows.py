"""Tests reading a reproduction into arrays by seed, episode and robot, and its refusals."""

import json
from pathlib import Path

import numpy as np
import pytest
from reproductions import SEEDS, episode, row, whole, write
from sentences import refusal

from swarmjax.reproduce import rows as reproduce_rows
from swarmjax.reproduce.rows import ACTIONS, EXPANDED, LAST

PAIR = ("curriculum", "baseline")


def _three(*episodes: dict) -> list[dict]:
    """Returns the same episodes for each of three seeds."""
    return [each | {"seed": seed} for seed in SEEDS for each in episodes]


def test_episodes_are_laid_out_by_robot(tmp_path: Path) -> None:
    first = episode(
        1,
        stage="paper1",
        reached=[True, False],
        reward=[0.25, -0.5],
        robot_steps=[60, 100],
        sensed=[3, 4],
        contacts=[0, 2],
    )
    second = episode(2, reached=[True, True, False], reward=[1, 0.5, 0.125])
    data = reproduce_rows.read(write(tmp_path, {"curriculum": _three(first, second)}))
    assert tuple(data.seeds) == SEEDS
    assert len(data.logs["curriculum"]) == 3
    log = data.logs["curriculum"][1]
    # An absent robot reaches no target and collects no reward.
    np.testing.assert_array_equal(log.present, [[True, True, False], [True, True, True]])
    np.testing.assert_array_equal(log.reached, [[True, False, False], [True, True, False]])
    np.testing.assert_array_equal(log.reward, [[0.25, -0.5, 0.0], [1.0, 0.5, 0.125]])
    np.testing.assert_array_equal(log.robot_steps, [[60, 100, 0], [100, 100, 100]])
    np.testing.assert_array_equal(log.sensed, [[3, 4, 0], [10, 10, 10]])
    np.testing.assert_array_equal(log.contacts, [[0, 2, 0], [1, 1, 1]])
    # The episodes of a stage keep their numbers in the run.
    last = log.on(LAST)
    assert (last.number.tolist(), last.arena_steps.tolist(), len(last)) == ([2], [200], 1)
    assert log.on(None) is log


def test_episodes_of_an_update_are_ordered_by_their_ends(tmp_path: Path) -> None:
    late, soon = episode(3, update=0, contacts=[7, 7]), episode(1, update=0)
    data = reproduce_rows.read(write(tmp_path, {"curriculum": _three(late, soon)}))
    log = data.logs["curriculum"][0]
    assert log.arena_steps.tolist() == [100, 300]
    assert log.contacts[:, 0].tolist() == [1, 7]
    assert log.number.tolist() == [1, 2]


def test_evaluations_are_laid_out_by_seed(tmp_path: Path) -> None:
    rows = [
        row("baseline", seed, stage, action, targets_reached=share + seed / 10)
        for stage, share in ((EXPANDED, 0.5), (LAST, 0.75))
        for seed in reversed(SEEDS)
        for action in ACTIONS
    ]
    data = reproduce_rows.read(write(tmp_path, {"baseline": _three(episode(1))}, rows))
    judged = {stage: data.judged["baseline", stage, "mean"] for stage in (LAST, EXPANDED)}
    np.testing.assert_array_equal(judged[LAST]["targets_reached"], [0.75, 0.75 + 0.1, 0.75 + 0.2])
    np.testing.assert_array_equal(judged[EXPANDED]["targets_reached"], [0.5, 0.5 + 0.1, 0.5 + 0.2])
    np.testing.assert_array_equal(judged[EXPANDED]["contacts_per_robot"], [1.5] * 3)


def test_an_arm_that_has_not_finished_is_left_out(tmp_path: Path) -> None:
    out = whole(tmp_path, arms=PAIR)
    (out / "modern_curriculum").mkdir()
    (out / "modern_curriculum" / "episodes.jsonl").write_text("not read\n")
    data = reproduce_rows.read(out)
    assert list(data.logs) == list(PAIR)
    assert data.lacking(("baseline", "modern_curriculum")) == ["modern_curriculum"]


def _change(out: Path, name: str, **given: object) -> None:
    found = json.loads((out / name).read_text())
    (out / name).write_text(json.dumps(found | given))


def _append(out: Path, **given: object) -> None:
    with (out / "baseline" / "episodes.jsonl").open("a") as file:
        file.write(json.dumps(episode(99) | given) + "\n")


def _drop(out: Path, text: str) -> None:
    """Removes the lines that contain `text` from the baseline's log."""
    path = out / "baseline" / "episodes.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if text not in line))


REFUSED = {
    "no facts": (lambda out: (out / "reproduce.json").unlink(), "is not a reproduction"),
    "format": (
        lambda out: _change(out, "reproduce.json", format=3),
        "has format 3, but this version reads only format 4; commit 8820a9f was the last to read "
        "format 3.",
    ),
    "settings": (lambda out: _change(out, "reproduce.json", settings=[]), "as settings"),
    "a setting": (
        lambda out: _change(out, "reproduce.json", settings={"seeds": 2}),
        "settings.seeds is 2: give 3 to 4096.",
    ),
    "no arm": (
        lambda out: [_change(out, f"{arm}/summary.json", budget_spent=False) for arm in PAIR],
        "no finished arm",
    ),
    "seconds": (lambda out: _change(out, "baseline/summary.json", train_s="x"), "as train_s"),
    "no log": (
        lambda out: (out / "baseline" / "episodes.jsonl").unlink(),
        "baseline has no episodes.jsonl",
    ),
    "a seed": (
        lambda out: _drop(out, '"seed": 2'),
        "no complete episode of seed 2: give a larger budget",
    ),
    "another seed": (lambda out: _append(out, seed=3), "has seed 3"),
    "lengths": (lambda out: _append(out, sensed=[1]), "has no list of 2 whole numbers as sensed"),
    "no robots": (lambda out: _append(out, robots=0), "as reached"),
    "kinds": (lambda out: _append(out, reached=[1, 0]), "as reached"),
    "counts": (lambda out: _append(out, contacts=[-1, 0]), "as contacts"),
    "nan": (lambda out: _append(out, reward=[float("nan"), 0.0]), "as reward"),
    "stage": (lambda out: _append(out, stage=6), "as stage"),
    "no evaluation": (
        lambda out: (out / "evaluation.json").unlink(),
        "evaluation.json has no row for arm curriculum, seed 0, stage paper6",
    ),
    "rows": (
        lambda out: _change(out, "evaluation.json", rows=[row("baseline", 0, LAST)]),
        "has no row for arm curriculum, seed 0, stage paper6",
    ),
    "no rows": (
        lambda out: _change(out, "evaluation.json", rows=None),
        "has no list of rows: delete this file to evaluate again.",
    ),
    "a row": (lambda out: _change(out, "evaluation.json", rows=[[]]), "has no list of rows"),
    "a row's seed": (
        lambda out: _change(
            out, "evaluation.json", rows=[row("baseline", 0, LAST) | {"seed": [0]}]
        ),
        "row 1, has no whole number as seed",
    ),
    "a measure": (
        lambda out: _change(
            out, "evaluation.json", rows=[row("baseline", 0, LAST, all_reached=float("inf"))]
        ),
        "as all_reached",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_missing_or_damaged_is_named(name: str, tmp_path: Path) -> None:
    out = whole(tmp_path, arms=PAIR)
    damage, words = REFUSED[name]
    damage(out)
    assert words in refusal(reproduce_rows.read, out)
