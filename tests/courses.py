"""Runs the bare environment, for comparison with the adapters."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.environment import Swarm
from swarmjax.task.stage_config import StageConfig

# With seed 2 robots of the swarm arrive, wait, complete their episode and run out of time. With
# seed 9 one robot of the arena arrives after 43 steps, and the other runs out of time after 80.
SEED, ARENA_SEED, STEPS, LIMIT = 2, 9, 120, 80
# Robots arrive sooner at large targets.
TASK = {"step_limit": LIMIT, "target_radius": 0.1}
PAIR = StageConfig(name="pair", robots=2, side=0.5)
ONE = StageConfig(name="one", robots=1, side=0.5)


class Course(NamedTuple):
    """A rollout of the bare environment, [T, A, R, ...]: observation, action, result of the step.

    `after` is the observation in the new state.
    """

    seen: np.ndarray
    action: np.ndarray
    came: Any
    after: np.ndarray


def steer(seen: Any) -> Any:
    """Returns actions [..., 2] for observations [..., O]: full speed and a turn to the target."""
    return jnp.stack([jnp.ones_like(seen[..., 9]), jnp.clip(seen[..., 9], -1, 1)], axis=-1)


def follow(swarm: Swarm, key: Any) -> Course:
    """Steers all robots for `STEPS` control steps in the bare environment."""

    def step(state, _):
        action = steer(state.observation)
        new, came = swarm.step(state, action)
        return new, (state.observation, action, came, new.observation)

    first = jax.jit(swarm.reset)(key)
    _, found = jax.jit(lambda state: jax.lax.scan(step, state, length=STEPS))(first)
    return Course(*jax.tree.map(np.asarray, found))


def drawn_key(seed: int) -> Any:
    """Returns the key that adapters on the host derive from the seed."""
    return jax.random.key(int(np.random.default_rng(seed).integers(2**31)))


ARENAS = np.array([0, 0, 1, 2, 2, 3])  # The arena of each of the six robots.
PLACES = np.array([0, 1, 2, 4, 5, 6])  # The six robots' indices in the flattened [A, R].


def robots(x: np.ndarray) -> np.ndarray:
    """Returns the entries [N, ...] of the six robots in [A, R, ...]."""
    return x.reshape(-1, *x.shape[2:])[PLACES]


# Compares the results of two programs, whose sums XLA may order differently.
assert_close = partial(np.testing.assert_allclose, rtol=0.0, atol=1e-5)
