"""How fast is CAMAR with differential drives?

Among the JAX environments for path finding in continuous space, CAMAR is the most similar to ours.
`python -m benchmarks.peer_camar [arenas=4096,65536] ...` needs the extra `camar` and prints a JSON
line for each number of arenas. Each timed call is one compiled scan of `steps` control steps with
random actions. CAMAR's own wrapper resets arenas optimistically: each step draws one new map per
`reset_ratio` arenas, and the arenas whose episodes end in this step share these maps.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import key_value, peers, timing
from benchmarks.peers import PeerConfig
from swarmjax import epuck, provenance
from swarmjax.config import about

FRAMESKIP = 2  # CAMAR's default; a control step has three substeps
DT = 0.032 / (FRAMESKIP + 1)  # s
CELLS = 6  # cells per side; they are 0.2 m wide, so the arena is 1.2 m wide
COUNTED = {
    "step": "control step: three substeps of penalty contacts between discs in the plane, the "
    "vectors to the nearest objects instead of rays, reward",
    "resets": "optimistic: one fresh map for every reset_ratio arenas and step",
    "precision": "float32",
}


@dataclass(frozen=True, kw_only=True)
class CamarConfig(PeerConfig):
    """Settings for measuring CAMAR."""

    reset_ratio: int = field(default=64, metadata=about("arenas that share a reset", 1, 2**20))


def task(config: PeerConfig) -> dict[str, Any]:
    """Returns the task's settings for `camar_v0`, with lengths in m."""
    return {
        "map_generator": "random_grid",
        "dynamic": "DiffDriveDynamic",
        "dynamic_kwargs": {
            "linear_speed_min": 0.0,
            "linear_speed_max": epuck.MAX_SPEED,
            "angular_speed_min": -epuck.MAX_TURN_RATE,
            "angular_speed_max": epuck.MAX_TURN_RATE,
            "dt": DT,
        },
        "map_kwargs": {
            "num_agents": config.robots,
            "num_rows": CELLS,
            "num_cols": CELLS,
            "obstacle_density": 0.1,
            "obstacle_size": 0.2,
            "agent_rad_range": (epuck.HULL_RADIUS, epuck.HULL_RADIUS),
            "goal_rad_range": (0.05, 0.05),
        },
        "max_steps": config.step_limit,
        "frameskip": FRAMESKIP,
        "window": epuck.SENSOR_RANGE + epuck.HULL_RADIUS,
    }


def results(config: CamarConfig) -> Iterator[dict[str, Any]]:
    """Measures the speed with each number of arenas, and yields a JSON line for each number."""
    camar = peers.find("camar", "the extra camar")
    wrappers = peers.find("camar.wrappers", "the extra camar")
    for arenas in config.arenas:
        bare = camar.camar_v0(**task(config))
        world = wrappers.OptimisticResetVecEnvWrapper(
            bare, arenas, reset_ratio=min(config.reset_ratio, arenas)
        )
        key = jax.random.key(config.seed)
        _, state = world.reset(key)
        program = timing.compile_program(partial(_steps, world, config), (state, key), None)
        calls_s, _ = timing.time_program(program, (state, key), None, config.repeats)
        yield {
            "benchmark": "peer_camar.environment",
            "peer": "CAMAR random_grid",
            **peers.speed(config, arenas, FRAMESKIP + 1, calls_s),
            "reset_ratio": min(config.reset_ratio, arenas),
            "compile_s": program.compile_s,
            "program_bytes": program.size,
            **COUNTED,
            "matmul_precision": timing.matmul_precision(),
            "settings": task(config),
            "device": provenance.device(),
            "versions": peers.versions("camar"),
            "commit": provenance.commit(),
        }


def _steps(world: Any, config: PeerConfig, carry: Any, _: None) -> tuple[Any, jax.Array]:
    """Steps all arenas with random actions; also returns a sum that depends on every result."""

    def body(carry: Any, _: None) -> tuple[Any, jax.Array]:
        state, key = carry
        key, action_key, step_key = jax.random.split(key, 3)
        shape = (world.num_envs, config.robots, 2)
        action = jax.random.uniform(action_key, shape, minval=-1.0, maxval=1.0)
        seen, state, reward, _, _ = world.step(step_key, state, action)
        return (state, key), jnp.sum(reward) + jnp.sum(seen)

    carry, rewards = jax.lax.scan(body, carry, length=config.steps)
    return carry, jnp.sum(rewards)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    peers.write(results(key_value.load(CamarConfig, arguments)))
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("peer_camar", main, CamarConfig))
