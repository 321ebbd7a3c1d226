"""Pieces of your own: a reward term, an observation, a way of drawing levels and a network.

Train with them, and judge what was trained:

    python -m swarmjax.train extensions=examples/own_pieces.py stage=examples/ring.yaml
    python -m swarmjax.evaluate policy=runs/NAME/policy.npz extensions=examples/own_pieces.py
"""

import jax
import jax.numpy as jnp
from flax import linen as nn

from swarmjax.extension import level_drawing, network, observation, reward_term
from swarmjax.task.level import Level
from swarmjax.task.observation import View
from swarmjax.task.reward import Step


@reward_term(weight=-0.0005)
def turning(step: Step) -> jax.Array:
    """The square of the turn command: a price on zigzag, [R]."""
    return step.action[:, 1] ** 2


@observation(unit="m")
def nearest_robot(view: View) -> jax.Array:
    """Distance to the nearest other robot, 1 m at most, [R]."""
    place = view.pose[:, :2]
    apart = jnp.linalg.norm(place[:, None] - place[None, :], axis=-1)
    other = view.present[None, :] & ~jnp.eye(len(place), dtype=bool)
    return jnp.min(jnp.where(other, apart, 1.0), axis=1, initial=1.0)


@level_drawing
def ring(level: Level, key: jax.Array) -> Level:
    """Robots on a circle, each with its target on the other side; no obstacles."""
    robots = level.present.shape[0]
    spread = 2 * jnp.pi / jnp.sum(level.present)
    angle = jax.random.uniform(key, maxval=2 * jnp.pi) + spread * jnp.arange(robots)
    place = 0.35 * level.side * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    start = jnp.concatenate([place, angle[:, None] + jnp.pi], axis=-1)
    absent = jnp.zeros_like(level.obstacle_present)
    return level._replace(start=start, target=-place, obstacle_present=absent)


@network
class Residual(nn.Module):
    """Two layers, the second around a shortcut."""

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Turns observations [..., O] into features [..., 64]."""
        features = nn.tanh(nn.Dense(64)(observation))
        return features + nn.tanh(nn.Dense(64)(features))
