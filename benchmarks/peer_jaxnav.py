"""How fast is JaxNav, JaxMARL's environment of differential drives with range sensors?

`python -m benchmarks.peer_jaxnav [arenas=4096,65536] [step=pool] ...` needs the extra `jaxmarl` and
prints a JSON line for each number of arenas and each way to step. `step=pool` calls JaxNav's
`step_env`, and restarts arenas from a pool of states that were drawn beforehand. This is JaxNav's
best case. `step=default` calls JaxNav's own `step`, which draws a whole map for every arena and
step, and discards nearly all of these maps. Each timed call is one compiled scan of `steps` control
steps with random actions.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from benchmarks import key_value, peers, timing
from benchmarks.peers import PeerConfig
from swarmjax import epuck, provenance
from swarmjax.config import about

# JaxNav's cells are 1 m wide and its robots have a radius of 0.3 m, so our lengths are scaled by
# 0.3 / 0.037. Our rays of 0.04 m would be 0.32 m long here. They are 0.3 m long, because samples
# along a ray have JaxNav's default spacing of 0.05 m.
RADIUS = 0.3
BEAMS, RANGE, RESOLUTION = 8, 0.3, 0.05
CELLS = 7  # cells per side; the outer cells are walls
RESETS = {
    "pool": "one of a pool of states that were drawn beforehand, at random: its best case",
    "default": "a new map for every arena and step, used where an episode ends: its default",
}
COUNTED = {
    "step": "control step: kinematics in the plane, collisions end a robot's way, 8 rays marched "
    "over a grid map, reward",
    "precision": "float32",
}


@dataclass(frozen=True, kw_only=True)
class JaxNavConfig(PeerConfig):
    """Settings for measuring JaxNav."""

    step: tuple[Literal["pool", "default"], ...] = field(
        default=("pool", "default"), metadata=about("how an ended episode starts again")
    )
    pool: int = field(default=1024, metadata=about("states in the pool", 1, 2**20))


def task(config: PeerConfig) -> dict[str, Any]:
    """Returns the task's settings for `jaxmarl.make`."""
    return {
        "num_agents": config.robots,
        "act_type": "Continuous",
        "rad": RADIUS,
        "lidar_num_beams": BEAMS,
        "lidar_max_range": RANGE,
        "lidar_range_resolution": RESOLUTION,
        "map_id": "Grid-Rand-Poly",
        "map_params": {"map_size": (CELLS, CELLS), "fill": 0.1},
        "max_v": 1.0,
        "max_w": epuck.MAX_TURN_RATE,
        "goal_radius": 0.4,
        "dt": 0.032,
        "max_steps": config.step_limit,
    }


def make(config: PeerConfig) -> Any:
    """Makes the environment; raises MissingPeerError if JaxMARL is not installed."""
    return peers.find("jaxmarl", "the extra jaxmarl").make("jaxnav", **task(config))


def results(config: JaxNavConfig) -> Iterator[dict[str, Any]]:
    """Measures each number of arenas with each way to step, and yields a JSON line for each."""
    world = make(config)
    pool = draw_pool(world, config.pool, config.seed)
    for arenas in config.arenas:
        for how in config.step:
            carry = (begin(pool, arenas)[1], jax.random.key(config.seed))
            call = partial(_steps, world, config, how)
            program = timing.compile_program(call, carry, pool)
            calls_s, _ = timing.time_program(program, carry, pool, config.repeats)
            yield {
                "benchmark": "peer_jaxnav.environment",
                "peer": f"JaxMARL JaxNav, {'step_env' if how == 'pool' else 'step'}",
                "reset": how,
                **peers.speed(config, arenas, 1, calls_s),
                "compile_s": program.compile_s,
                "program_bytes": program.size,
                **COUNTED,
                "resets": RESETS[how],
                "matmul_precision": timing.matmul_precision(),
                "settings": task(config),
                "device": provenance.device(),
                "versions": peers.versions("jaxmarl"),
                "commit": provenance.commit(),
            }


def draw_pool(world: Any, size: int, seed: int) -> tuple[Any, Any]:
    """Draws a pool of observations and states [P] at which episodes start."""
    keys = jax.random.split(jax.random.key(seed), size)
    return jax.jit(jax.vmap(world.reset))(keys)


def begin(pool: tuple[Any, Any], arenas: int) -> tuple[Any, Any]:
    """Takes observations and states [A] from the pool in order, and starts over at its end."""
    index = jnp.arange(arenas) % len(jax.tree.leaves(pool)[0])
    return jax.tree.map(lambda x: x[index], pool)


def step(
    world: Any, how: str, pool: tuple[Any, Any], keys: Array, states: Any, actions: Any
) -> tuple[Any, Any, Any, Any, Any]:
    """Steps all arenas, and resets the arenas whose episodes have ended.

    Args:
      world: the environment, JaxNav.
      how: the way to step and reset, a key of `RESETS`.
      pool: start states from `draw_pool`.
      keys: [A] random keys.
      states: [A] states.
      actions: each robot's actions [A, 2], by the robot's name.

    Returns:
      The results of JaxMARL's `step`, [A]: observations, states, rewards, dones and infos.
    """
    if how == "default":
        return jax.vmap(world.step)(keys, states, actions)
    size = len(jax.tree.leaves(pool)[0])
    index = jax.vmap(lambda key: jax.random.randint(key, (), 0, size))(keys)
    seen, moved, reward, done, info = jax.vmap(world.step_env)(keys, states, actions)
    over = done["__all__"]

    def choose(fresh: Array, old: Array) -> Array:
        return jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), fresh[index], old)

    seen, moved = jax.tree.map(choose, pool, (seen, moved))
    return seen, moved, reward, done, info


def _steps(
    world: Any, config: PeerConfig, how: str, carry: tuple[Any, Array], pool: Any
) -> tuple[tuple[Any, Array], Array]:
    """Steps all arenas with random actions; also returns a sum that depends on every result."""
    arenas = len(jax.tree.leaves(carry[0])[0])
    low, high = jnp.array([0.0, -epuck.MAX_TURN_RATE]), jnp.array([1.0, epuck.MAX_TURN_RATE])

    def body(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], Array]:
        states, key = carry
        key, action_key, step_key = jax.random.split(key, 3)
        drawn = low + (high - low) * jax.random.uniform(action_key, (config.robots, arenas, 2))
        actions = dict(zip(world.agents, drawn, strict=True))
        keys = jax.random.split(step_key, arenas)
        seen, states, reward, _, _ = step(world, how, pool, keys, states, actions)
        sums = [jnp.sum(x) for x in jax.tree.leaves((seen, reward))]
        return (states, key), jnp.sum(jnp.stack(sums))

    carry, rewards = jax.lax.scan(body, carry, length=config.steps)
    return carry, jnp.sum(rewards)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    peers.write(results(key_value.load(JaxNavConfig, arguments)))
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("peer_jaxnav", main, JaxNavConfig))
