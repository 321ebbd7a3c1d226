"""Tests that both judges follow the goals: step by step together, and an extension's goal."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import extensions
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import steering
from sentences import refusal

from swarmjax import policy_file
from swarmjax.evaluate import cells, engine_c, engine_mjx, judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import evaluate
from swarmjax.sim import physics
from swarmjax.sim.config import RobotConfig
from swarmjax.task import env
from swarmjax.task.config import TaskConfig
from swarmjax.task.stage_config import StageConfig

STAGE = StageConfig(name="three", robots=3, side=1.0, obstacles=0)
LEVEL = 2  # nothing is touched in it for 110 control steps
GOALS = {
    "moving": TaskConfig(target_speed=0.05),
    "lifelong": TaskConfig(goal="lifelong"),
    "gather": TaskConfig(goal="gather"),
    "cover": TaskConfig(goal="cover"),
}
KEEP_APART = """
from swarmjax.extension import goal
from swarmjax.task.goals.goal import Goal, Measure, Turn

@goal
class KeepApart(Goal):
    measures = {"nearest_m": Measure("distance to the nearest robot", "m", is_good=True)}

    def advance(self, state, level, view):
        step = view.pose[:, None, :2] - view.pose[None, :, :2]
        far = jnp.where(jnp.eye(len(step), dtype=bool), jnp.inf, jnp.hypot(*step.T))
        nearest = far.min(axis=-1)
        return Turn(state, -view.pose[:, :2], nearest > 0.3,
                    measured={"nearest_m": nearest.min()})
"""
MISTAKES = [
    (
        "    measures =",
        "    others =",
        "has no measures: add measures = {name: Measure(label, unit)} to the class.",
    ),
    (
        "    measures =",
        "    ends = 'al'\n    measures =",
        "has ends 'al': give one of each, all, never.",
    ),
    (
        "    measures =",
        "    drives = None\n    measures =",
        "defines drives, which goals must not change: rename it.",
    ),
    (
        "return Turn(",
        "return (lambda *parts, **more: parts)(",
        "returns no Turn from advance: return Turn(state, target, ...).",
    ),
    (
        "measured={",
        "measured={'far': nearest.max(), ",
        "returns a Turn that measures far, nearest_m: return a Turn that measures nearest_m.",
    ),
    (
        "nearest > 0.3",
        "nearest.min() > 0.3",
        "returns arrived as bool of shape []: return bool of shape [3].",
    ),
    (
        "return Turn(state,",
        "return Turn(nearest,",
        "returns a state from advance that differs from that of begin: return arrays of the same "
        "shapes and types, here ().",
    ),
]


def _settings(path: Path, **rest: Any) -> EvaluateConfig:
    given: dict[str, Any] = {"stage": STAGE, "robot": RobotConfig(), "workers": 1}
    return EvaluateConfig(policy=str(path), **(given | rest))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return steering.write(tmp_path_factory.mktemp("goals") / "policy.npz")


@pytest.mark.parametrize("name", GOALS)
def test_training_and_judge_agree_at_every_step(path: Path, name: str) -> None:
    settings = _settings(path, task=GOALS[name])
    trained = policy_file.read(str(path))
    level = cells.split(cells.draw_stage(settings, [LEVEL]).levels)[0]
    mine = judge.load(settings, trained, level.obstacle[:, 3:])
    arenas = engine_c.start(mine, [level])
    world = engine_mjx.load(settings, level.obstacle[:, 3:], 1)
    state = env.reset(world, jax.tree.map(jnp.asarray, level))
    state = replace(state, sim=physics.unpack(world.physics, state.sim))
    step = jax.jit(partial(env.step, world))
    jumps = 0
    for _ in range(150):
        _, action = engine_c.act(mine, None, arenas)
        state, came = step(state, jnp.asarray(action[0], jnp.float32))
        before, arenas = arenas.target, engine_c.step(mine, arenas, action)
        jumps += (arenas.target != before).any()
        if arenas.outcome.contacts.any():
            break
        # Both engines stay within 1 mm of each other as long as nothing is touched.
        np.testing.assert_allclose(state.level.target, arenas.target[0], atol=1e-3)
        np.testing.assert_array_equal(state.arrived, arenas.outcome.arrived[0])
        np.testing.assert_allclose(came.measured, arenas.outcome.measured[0], atol=1e-3)
        np.testing.assert_allclose(state.observation, arenas.observation[0], atol=5e-3)
    assert jumps
    assert arenas.outcome.clock[0] > 110


@pytest.mark.parametrize("engine", ["c", "mjx"])
def test_a_goal_of_ones_own_is_judged_by_its_own_measure(
    tmp_path: Path, path: Path, engine: str
) -> None:
    own = extensions.write(tmp_path / "own.py", KEEP_APART)
    settings = _settings(
        path,
        task=TaskConfig(goal="keep_apart"),
        extensions=own,
        engine=engine,
        episodes=4,
        steps=30,
    )
    found = evaluate(settings).result
    assert found["own_measures"] == {
        "nearest_m": {"label": "distance to the nearest robot", "unit": "m", "is_good": True}
    }
    measured = found["cells"][0]["measures"]
    # Three robots start at least two hulls apart, in an arena with a diagonal of 1.41 m.
    assert 0.074 < measured["nearest_m"]["mean"] < 1.41
    assert "spl" not in measured
    json.dumps(found)


@pytest.mark.parametrize("engine", ["c", "mjx"])
@pytest.mark.parametrize(("old", "new", "sentence"), MISTAKES)
def test_a_goal_with_a_mistake_is_refused(
    tmp_path: Path, path: Path, engine: str, old: str, new: str, sentence: str
) -> None:
    own = extensions.write(tmp_path / "own.py", KEEP_APART.replace(old, new))
    settings = _settings(path, task=TaskConfig(goal="keep_apart"), extensions=own, engine=engine)
    assert refusal(evaluate, settings) == f"goal keep_apart {sentence}"
