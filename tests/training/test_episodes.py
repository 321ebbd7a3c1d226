"""Checks that `episodes.jsonl` lists every episode once, with the numbers of each robot."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from swarmjax.run.compiled import compile_chunk
from swarmjax.run.load_settings import load_train
from swarmjax.run.run import Run
from swarmjax.run.settings import TrainConfig
from swarmjax.task.episode import Ended, Robots
from swarmjax.training import episodes, mesh
from swarmjax.training import program as programs


def _ended(done: np.ndarray, robots: int) -> Ended:
    """Returns episodes [T, A] that ended where `done`; numbers encode step, arena and robot."""
    steps, arenas = done.shape
    number = 10 * np.arange(steps)[:, None] + np.arange(arenas)
    by_robot = 100 * number[..., None] + np.arange(robots)
    mine, each = np.where(done, number, 0), np.where(done[..., None], by_robot, 0)
    found = dict.fromkeys(Ended._fields, mine) | {"episodes": done.astype(np.int32)}
    found["robots"] = Robots(
        present=done[..., None] & (np.arange(robots) < 2),
        reached=each % 2 == 1,
        reward=each.astype(np.float32),
        robot_steps=each,
        sensed=each + 1,
        contacts=each + 2,
    )
    return Ended(**{**found, "stage": np.where(done, number % 2, 0)})


def test_packing_keeps_every_episode_in_its_order() -> None:
    done = np.random.default_rng(0).uniform(size=(7, 3)) < 0.4
    ended = _ended(done, robots=3)
    log = episodes.pack(ended, size=21)
    # [1 seed, 1 row]
    lane = jax.tree.map(lambda x: np.asarray(x)[None, None], log)
    rows, lost = episodes.rows(lane, np.array([4]), ("a", "b"), [7], control_steps=21)
    assert lost == 0
    expected = []
    for step in range(7):
        for arena in range(3):
            if done[step, arena]:
                number = 10 * step + arena
                numbers = [100 * number, 100 * number + 1]
                expected.append(
                    {
                        "seed": 7,
                        "update": 4,
                        "arena_steps": 4 * 21 + 3 * (step + 1),
                        "stage": "ab"[number % 2],
                        "steps": number,
                        "robots": 2,
                        "reached": [False, True],
                        "reward": numbers,
                        "robot_steps": numbers,
                        "sensed": [x + 1 for x in numbers],
                        "contacts": [x + 2 for x in numbers],
                    }
                )
    assert rows == expected
    assert json.loads(json.dumps(rows)) == expected


def test_episodes_that_have_no_room_are_counted() -> None:
    ended = _ended(np.ones((3, 2), bool), robots=2)
    log = jax.tree.map(lambda x: np.asarray(x)[None, None], episodes.pack(ended, size=4))
    rows, lost = episodes.rows(log, np.array([0]), ("a", "b"), [0], control_steps=6)
    assert (len(rows), lost) == (4, 2)
    assert [row["arena_steps"] for row in rows] == [2, 2, 4, 4]  # the first ones are kept


def test_there_is_room_for_all_that_can_be_drawn() -> None:
    paper = load_train(["algo=paper"])
    assert episodes.room(paper) == 6000 // 32 + 1
    short = replace(paper, arenas=2, task=replace(paper.task, step_limit=10))
    assert episodes.room(short) == 2 * 601  # one every ten steps, and the running one
    assert paper.waiting < episodes.room(paper)


def test_fewer_drawn_levels_take_no_room_away() -> None:
    """An arena that runs out of levels repeats the last one, and these episodes end, too."""
    paper = load_train(["algo=paper"])
    fewer = replace(paper, levels_per_rollout=1)
    assert episodes.room(fewer) == episodes.room(paper)


Train = Callable[..., None]


@pytest.fixture(scope="module")
def train_for(tiny_config: TrainConfig) -> Train:
    """Returns a function that trains on one stage up to an update.

    The function writes into a run directory. It starts from the beginning or from the run's
    checkpoint.
    """
    base = replace(
        tiny_config,
        stage=tiny_config.stage[1:],
        stage_name="",
        budget=64 * 6,
        run=replace(tiny_config.run, episodes=True, tensorboard=False),
    )
    program, schedule = programs.load(base, by_robot=True)
    init = jax.jit(mesh.init(program))
    compiled = compile_chunk(program, schedule, init(schedule))

    def train_for(run: Path, updates: int, *, resume: bool = False) -> None:
        settings = replace(
            base, run=replace(base.run, stop_after=updates), resume=str(run) if resume else None
        )
        mine = Run(settings)
        mine.path, mine.compiled = run, compiled
        mine.load()
        mine._train_chunks()

    return train_for


def _lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def whole(train_for: Train, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("whole")
    train_for(run, 6)
    return run


@pytest.mark.slow
def test_sums_over_episodes_are_the_metrics(whole: Path) -> None:
    rows, metrics = _lines(whole / "episodes.jsonl"), _lines(whole / "metrics.jsonl")
    assert [each["update"] for each in metrics] == list(range(6))
    for column in metrics:
        mine = [row for row in rows if row["update"] == column["update"]]
        assert len(mine) == column["episodes"]
        assert all(row["robots"] == 3 and row["stage"] == "trio" for row in mine)
        assert sum(row["steps"] for row in mine) == column["steps"]
        for name in ("reached", "sensed", "robot_steps", "contacts"):
            assert sum(sum(row[name]) for row in mine) == column[name], name
        # float32, summed in another order.
        reward = sum(sum(row["reward"]) for row in mine)
        np.testing.assert_allclose(reward, column["reward"], atol=1e-5)
        ends = [row["arena_steps"] for row in mine]
        assert ends == sorted(ends)
        assert all(64 * column["update"] < end <= column["arena_steps"] for end in ends)
    # Episodes of 16 steps end in every second rollout of 8 steps, in each of 8 arenas. Few end
    # earlier by arrival.
    assert len(rows) >= 3 * 8
    assert any(any(row["sensed"]) for row in rows)


@pytest.mark.slow
def test_a_resumed_run_writes_the_same_episodes(
    whole: Path, train_for: Train, tmp_path: Path
) -> None:
    train_for(tmp_path, 4)
    with (tmp_path / "episodes.jsonl").open("a") as file:
        # A killed process leaves a line from after the checkpoint, and an unfinished line.
        file.write('{"seed": 0, "update": 4}\n{"seed": 0, "upd')
    train_for(tmp_path, 6, resume=True)
    expected = (whole / "episodes.jsonl").read_text()
    assert (tmp_path / "episodes.jsonl").read_text() == expected


@pytest.mark.parametrize("count", [1, 3])
def test_a_call_hands_on_no_more_than_is_held(count: int) -> None:
    paper = load_train(["algo=paper", f"seeds={count}"])
    held = episodes.rows_of_call(paper) * count * episodes.room(paper)
    assert held <= episodes.MOST_HELD < held + count * episodes.room(paper)
