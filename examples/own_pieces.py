"""Defines your own pieces: a reward term, an observation, a drawing of levels and a network.

Train with them, and evaluate the policy:

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
    """Returns the square of the turn command, to penalise zigzag, [R]."""
    return step.action[:, 1] ** 2


@observation(unit="m")
def nearest_robot(view: View) -> jax.Array:
    """Returns the distance to the nearest other robot, at most 1 m, [R]."""
    place = view.pose[:, :2]
    apart = jnp.linalg.norm(place[:, None] - place[None, :], axis=-1)
    other = view.present[None, :] & ~jnp.eye(len(place), dtype=bool)
    return jnp.min(jnp.where(other, apart, 1.0), axis=1, initial=1.0)


@level_drawing
def ring(level: Level, key: jax.Array) -> Level:
    """Places robots on a circle, each with its target on the opposite side; no obstacles."""
    robots = level.present.shape[0]
    spread = 2 * jnp.pi / jnp.sum(level.present)
    angle = jax.random.uniform(key, maxval=2 * jnp.pi) + spread * jnp.arange(robots)
    place = 0.35 * level.side * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    start = jnp.concatenate([place, angle[:, None] + jnp.pi], axis=-1)
    absent = jnp.zeros_like(level.obstacle_present)
    return level._replace(start=start, target=-place, obstacle_present=absent)


@network
class Residual(nn.Module):
    """Two layers, the second with a skip connection."""

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Computes features [..., 64] from observations [..., O]."""
        features = nn.tanh(nn.Dense(64)(observation))
        return features + nn.tanh(nn.Dense(64)(features))
