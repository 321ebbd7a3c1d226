"""What the bare environment does, for adapters to be compared with."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.environment import Swarm
from swarmjax.task.stage_config import StageConfig

# By seed 2 robots of the swarm arrive, wait, complete and run out of time; by seed 9 one of the
# arena's arrives after 43 steps and the other runs out of time after 80.
SEED, ARENA_SEED, STEPS, LIMIT = 2, 9, 120, 80
# Robots arrive sooner at large targets; one iteration compiles sooner.
TASK = {"step_limit": LIMIT, "target_radius": 0.1}
PAIR = StageConfig(name="pair", robots=2, side=0.5)
ONE = StageConfig(name="one", robots=1, side=0.5)


class Course(NamedTuple):
    """What the bare environment does, [T, A, R, ...]: what is seen, told, and comes of it."""

    seen: np.ndarray
    action: np.ndarray
    came: Any
    after: np.ndarray


def steer(seen: Any) -> Any:
    """Drives robots [..., O] to their targets: [..., 2] full speed, turning to the bearing."""
    return jnp.stack([jnp.ones_like(seen[..., 9]), jnp.clip(seen[..., 9], -1, 1)], axis=-1)


def follow(swarm: Swarm, key: Any) -> Course:
    """Steers all robots for a while, in the bare environment."""

    def step(state, _):
        action = steer(state.observation)
        new, came = swarm.step(state, action)
        return new, (state.observation, action, came, new.observation)

    first = jax.jit(swarm.reset)(key)
    _, found = jax.jit(lambda state: jax.lax.scan(step, state, length=STEPS))(first)
    return Course(*jax.tree.map(np.asarray, found))


def drawn_key(seed: int) -> Any:
    """The key that adapters of the host make of the seed."""
    return jax.random.key(int(np.random.default_rng(seed).integers(2**31)))


ARENAS = np.array([0, 0, 1, 2, 2, 3])  # of the six robots
PLACES = np.array([0, 1, 2, 4, 5, 6])  # of the six robots among [A R], worked out by hand


def robots(x: np.ndarray) -> np.ndarray:
    """[A, R, ...] to [N, ...]."""
    return x.reshape(-1, *x.shape[2:])[PLACES]


# One program against another, whose sums XLA may order otherwise.
assert_close = partial(np.testing.assert_allclose, rtol=0.0, atol=1e-5)
