"""Tests both judges with `task.arrival=hold`: a scene worked out by hand, and the same levels."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import holding
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import steering
from holding import ENTERS, LEAVES, OTHER, PACE, RETURNS

from swarmjax import policy_file
from swarmjax.evaluate import cells, engine_c, engine_mjx, judge, measures
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import Evaluation, evaluate
from swarmjax.evaluate.measures import Outcome
from swarmjax.sim.config import RobotConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.env import EnvState
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig

PAIR = StageConfig(name="pair", robots=2, side=0.8)
HOLD = TaskConfig(arrival="hold")
SECOND = 0.032

Play = Callable[[np.ndarray], Outcome]


def _settings(path: Path, **rest: Any) -> EvaluateConfig:
    """Returns settings with the planar body, whose motion is worked out by hand."""
    given: dict[str, Any] = {"stage": PAIR, "robot": RobotConfig(), "task": HOLD, "workers": 1}
    return EvaluateConfig(policy=str(path), **(given | rest))


def _by_c(path: Path, actions: np.ndarray) -> Outcome:
    """Plays the scene in MuJoCo C until both robots have arrived or the actions end."""
    mine = judge.load(_settings(path), policy_file.read(str(path)))
    arenas = engine_c.start(mine, [holding.level()])
    for action in actions:
        arenas = engine_c.step(mine, arenas, action[None])
        if arenas.outcome.arrived.all():
            break
    return arenas.outcome


def _by_mjx(path: Path, actions: np.ndarray) -> Outcome:
    """Plays the scene in the engine that trains."""
    levels = Level(*(np.asarray(field)[None] for field in holding.level()))
    world = engine_mjx.load(_settings(path), np.zeros((0, 2)), 1)

    def act(memory: Any, arenas: EnvState) -> tuple[Any, jax.Array]:
        row = jnp.minimum(arenas.clock, len(actions) - 1)
        return memory, jnp.asarray(actions)[row]

    run = jax.jit(partial(engine_mjx.run, world, act, steps=len(actions) + 5))
    _, outcome, broken = run(levels, memory=None)
    assert not np.asarray(broken).any()
    return Outcome(*map(np.asarray, outcome))


@pytest.fixture(scope="module", params=[_by_c, _by_mjx], ids=["c", "mjx"])
def play(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Play:
    path = steering.write(tmp_path_factory.mktemp("hold") / "policy.npz")
    return partial(request.param, path)


def test_complete_is_all_within_their_targets_at_once(play: Play) -> None:
    found = play(holding.actions())
    assert found.clock.tolist() == [RETURNS]
    assert found.arrived.tolist() == [[True, True]]
    # The arrival is the start of a robot's last stay, not the first time that robot 0 entered.
    assert found.arrival.tolist() == [[RETURNS, OTHER]]


def test_what_counts_as_on_the_way_are_steps_begun_outside(play: Play) -> None:
    found = play(holding.actions())
    # Robot 0 moves until it enters, and from the step after it left until it is back.
    assert found.moving.tolist() == [[ENTERS + RETURNS - LEAVES, OTHER]]
    # In 31 of these steps robot 0 only turned. The tolerance of 1e-3 m is for the first stride,
    # which starts from rest in C, and for float32.
    strides = ENTERS + RETURNS - LEAVES - 31
    np.testing.assert_allclose(found.path, [[strides * PACE, OTHER * PACE]], atol=1e-3)


def test_who_waits_within_the_target_never_stands_still(play: Play) -> None:
    """Robot 1 waits for 24 steps at its target; robot 0 turned for 31 steps and has come back."""
    assert play(holding.actions()).still.tolist() == [[0, 0]]


# --- episodes cut short, which the engine on the device does not support


@pytest.fixture(scope="module")
def steer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return steering.write(tmp_path_factory.mktemp("cut") / "policy.npz")


@pytest.mark.parametrize("steps", [ENTERS, LEAVES - 1, LEAVES, OTHER, RETURNS - 1])
def test_nobody_has_arrived_for_good_before(steer: Path, steps: int) -> None:
    found = _by_c(steer, holding.actions()[:steps])
    np.testing.assert_array_equal(found.arrived[0], holding.arrived()[steps - 1])
    assert found.arrival[0, 0] == (ENTERS if steps < LEAVES else 0)


def test_who_stays_away_is_late_and_the_other_has_arrived(steer: Path) -> None:
    outcome = _by_c(steer, holding.actions(drives_on=True))
    found = measures.per_level(outcome, SECOND, RETURNS)
    assert found["targets_reached"].tolist() == [0.5]
    assert found["all_reached"].tolist() == [0.0]
    assert found["time_outs"].tolist() == [1.0]
    assert found["time_to_reach_s"] == pytest.approx([(RETURNS + OTHER) / 2 * SECOND])


# --- the same levels


STAGE = StageConfig(name="s3", robots=3, side=0.7, obstacles=1)
EPISODES, STEPS = 24, 150


def _judged(path: Path, engine: Any, **rest: Any) -> Evaluation:
    given = {"stage": STAGE, "episodes": EPISODES, "steps": STEPS, "seed": 1}
    return evaluate(_settings(path, engine=engine, **(given | rest)))


@pytest.mark.slow
def test_the_judges_agree_on_the_same_levels(tmp_path: Path) -> None:
    # A robot turns to its target, drives slowly and never stops, so it passes through the target.
    path = steering.write(tmp_path / "policy.npz", ((0.2, 0.0), (-2.0, 2.0), (-2.0, -2.0)))
    (c,), (mjx,) = (_judged(path, engine).trials for engine in ("c", "mjx"))
    free = c.measures["contacts_per_robot"][0] == 0.0
    assert 5 < free.sum() < EPISODES
    assert 0.0 < c.measures["all_reached"].mean() < 1.0
    for name in ("targets_reached", "all_reached", "contacts_per_robot", "deadlocks", "time_outs"):
        np.testing.assert_array_equal(mjx.measures[name][0, free], c.measures[name][0, free], name)
    for name in ("time_to_reach_s", "episode_time_s"):
        # Without contacts, paths differ by rounding, which may shift an arrival by one step.
        found, expected = mjx.measures[name][0, free], c.measures[name][0, free]
        np.testing.assert_allclose(found, expected, atol=1.01 * SECOND, err_msg=name)
    np.testing.assert_allclose(mjx.measures["spl"][0, free], c.measures["spl"][0, free], atol=2e-3)


def test_the_rule_changes_what_is_judged_and_not_the_levels(tmp_path: Path) -> None:
    """Robots that drive ahead pass through their targets with `hold`, and stop with `latch`."""
    path = steering.write(tmp_path / "policy.npz", steering.AHEAD)
    latch, hold = (_judged(path, "c", task=TaskConfig(arrival=rule)) for rule in ("latch", "hold"))
    digests = [each.result["cells"][0]["digest"] for each in (latch, hold)]
    assert digests[0] == digests[1]
    reached = [each.trials[0].measures["targets_reached"].sum() for each in (latch, hold)]
    assert reached[0] > reached[1] == 0.0
    assert hold.result["task"]["arrival"] == "hold"


def test_a_level_is_judged_alike_beside_whatever_others(tmp_path: Path) -> None:
    """An arena that is complete stays complete while other arenas go on."""
    path = steering.write(tmp_path / "policy.npz")
    settings = _settings(path, stage=STAGE, episodes=12, steps=STEPS)
    mine = judge.load(settings, policy_file.read(str(path)))
    levels = cells.split(cells.load(settings).cells[0].levels)
    together = engine_c.simulate(mine, levels)
    assert together.arrived.all(axis=-1).any()
    for i, level in enumerate(levels):
        alone = engine_c.simulate(mine, [level])
        for whole, one in zip(together, alone, strict=True):
            np.testing.assert_array_equal(whole[i], one[0])
