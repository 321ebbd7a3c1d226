"""Steps 64 arenas with random actions and plots the paths in one: python random_arenas.py."""

import jax
import matplotlib.pyplot as plt
from jax import Array

import swarmjax
from swarmjax.environment import SwarmState

STEPS = 200

env = swarmjax.make_env("s6", arenas=64)


def step(state: SwarmState, key: Array) -> tuple:
    """Moves every robot with a random action; returns poses and rewards."""
    action = jax.random.uniform(key, (64, env.num_robots, 2), minval=-1.0)
    state, came = env.step(state, action)
    return state, (env.pose(state), came.reward)


first = jax.jit(env.reset)(jax.random.key(0))
keys = jax.random.split(jax.random.key(1), STEPS)
last, (pose, reward) = jax.jit(lambda state: jax.lax.scan(step, state, keys))(first)
print(f"{STEPS * 64:,} arena steps, mean reward of a robot {reward.mean():.5f}")  # noqa: T201

for robot in range(env.num_robots):
    plt.plot(*pose[:, 0, robot, :2].T, label=f"robot {robot}")
plt.scatter(*first.arenas.level.target[0].T, marker="x", color="black", label="targets")
plt.gca().set_aspect("equal")
plt.legend()
plt.savefig("random_arenas.png")
