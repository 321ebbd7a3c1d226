"""Tests that the environment imports no trainer, no learner and no curriculum."""

import subprocess
import sys

import pytest

ALONE = """
import sys
import jax
import jax.numpy as jnp
import numpy as np
from swarmjax.sim import physics
from swarmjax.sim.config import SimConfig
from swarmjax.task import env, level
from swarmjax.task import stage as task_stage
from swarmjax.task.stage_config import StageConfig
from swarmjax.task import world as task_world

stage = StageConfig(name="two", robots=2, side=0.6)
world = task_world.load((stage,), sim=SimConfig(impl="jax", max_robots=2, max_obstacles=0))
one = task_stage.select(task_stage.stack([stage]), np.intp(0))
uniform = np.random.default_rng(0).uniform(size=level.uniform_count(world.spacing))
state = env.reset(world, level.sample(uniform.astype(np.float32), one, world.spacing, jnp))
state = state.replace(sim=physics.unpack(world.physics, state.sim))
after, came = jax.jit(lambda s: env.step(world, s, jnp.ones((2, 2))))(state)
assert after.clock == 1 and bool(came.sound)
rooms = tuple(f"swarmjax.{room}" for room in ("ppo", "curriculum", "training", "run", "evaluate"))
print(sorted(name for name in sys.modules if name.startswith(rooms)))
"""


@pytest.mark.slow
def test_an_arena_steps_without_any_other_room() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ALONE], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
