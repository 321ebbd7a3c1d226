"""How many steps a second: physics alone, the environment with it, training with both?

`python -m benchmarks.steps_per_second [key=value ...]` takes the keys of `swarmjax.train` and
prints a JSON line for each of the three, the median of `REPEATS` timed calls after one that is
not counted; compile time is apart. All robots of the last stage act at random (physics and
environment) or by the policy that is being trained. Speeds are those of all `seeds` together.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax import command, config, curriculum, loop, provenance, rollout, seeds
from swarmjax.config import TrainConfig
from swarmjax.loop import Program
from swarmjax.sim import drive, physics
from swarmjax.task import env
from swarmjax.task.env import EnvState

REPEATS = 5
CONTROL_STEPS = 64  # of one call of physics and environment
TRAIN_SECONDS = 2.0  # of one call of training, about


def measure(call: Callable[[Any, Any], Any], state: Any, argument: Any) -> tuple[float, float, Any]:
    """Times `call(state, argument) -> (state, rest)`, the state donated.

    Returns:
      Seconds that compiling took, median seconds of a call, and the last result.
    """
    began = time.perf_counter()
    compiled = jax.jit(call, donate_argnums=0).lower(state, argument).compile()
    compile_s = time.perf_counter() - began
    taken, rest = [], None
    for _ in range(1 + REPEATS):
        began = time.perf_counter()
        state, rest = compiled(state, argument)
        jax.block_until_ready(rest)
        taken.append(time.perf_counter() - began)
    return compile_s, statistics.median(taken[1:]), rest


def physics_alone(program: Program, arenas: EnvState, key: Array) -> tuple[EnvState, Array]:
    """Moves all arenas with random commands; returns them and a number that depends on all."""
    world = program.world
    move = jax.vmap(partial(physics.step, world.physics))
    level = arenas.level
    data = jax.vmap(partial(physics.unpack, world.physics))(arenas.sim)

    def body(data: Any, key: Array) -> tuple[Any, None]:
        command = drive.command(_actions(program, key), world.drive, jnp)
        wheels = drive.wheel_speeds(command, world.drive, jnp)
        return move(data, level.side, level.obstacle, wheels), None

    data, _ = jax.lax.scan(body, data, jax.random.split(key, CONTROL_STEPS))
    packed = jax.vmap(physics.pack)(data)
    return replace(arenas, sim=packed), jnp.sum(packed.qpos)


def environment(
    program: Program, schedule: curriculum.Schedule, arenas: EnvState, key: Array
) -> tuple[EnvState, Array]:
    """Steps all arenas with random actions, resets and all; returns them and the reward."""
    world = program.world
    step = jax.vmap(partial(env.step, world))
    unpack = jax.vmap(partial(physics.unpack, world.physics))

    def body(arenas: EnvState, key: Array, starts: EnvState) -> tuple[EnvState, Array]:
        arenas, came = step(arenas, _actions(program, key))
        reward = jnp.sum(came.reward) + jnp.sum(came.observation)
        return rollout.restart(arenas, starts, came.done), reward

    def rolled(arenas: EnvState, key: Array) -> tuple[EnvState, Array]:
        level_key, key = jax.random.split(key)
        index = jnp.zeros(program.config.arenas, jnp.int32)
        starts = rollout.draw_starts(world, schedule.stages, index, jnp.int32(0), level_key)
        keys = jax.random.split(key, program.config.algo.rollout)
        arenas, reward = jax.lax.scan(partial(body, starts=starts), arenas, keys)
        return arenas, jnp.sum(reward)

    arenas = replace(arenas, sim=unpack(arenas.sim))
    keys = jax.random.split(key, _rollouts(program.config))
    arenas, reward = jax.lax.scan(rolled, arenas, keys)
    return replace(arenas, sim=jax.vmap(physics.pack)(arenas.sim)), jnp.sum(reward)


def _rollouts(settings: TrainConfig) -> int:
    """How many rollouts a call of the environment is."""
    return max(1, CONTROL_STEPS // settings.algo.rollout)


def _actions(program: Program, key: Array) -> Array:
    """Uniform random actions [A, R, 2]."""
    shape = (program.config.arenas, program.config.sim.max_robots, rollout.ACTION_SIZE)
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _line(
    program: Program,
    name: str,
    control_steps: int,
    timing: Sequence[float],
    transitions: float | None,
) -> dict:
    """Puts a result together under the names of docs/interface.md."""
    settings = program.config
    compile_s, seconds = timing
    arena_steps = control_steps * settings.seeds * settings.arenas / seconds
    robots = settings.stage[-1].robots
    substeps = config.substeps(settings.robot, settings.sim.substeps)
    return {
        "benchmark": f"steps_per_second.{name}",
        "robot": settings.robot.body,
        "impl": physics.resolve_impl(settings.sim.impl),
        "arenas": settings.arenas,
        "seeds": settings.seeds,
        "robots": robots,
        "substeps": substeps,
        "arena_steps_per_s": arena_steps,
        "robot_steps_per_s": arena_steps * robots,
        "physics_steps_per_s": arena_steps * substeps,
        "transitions_per_s": None if transitions is None else transitions / seconds,
        "compile_s": compile_s,
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def results(settings: TrainConfig) -> list[dict]:
    """Runs the three benchmarks and returns their lines."""
    program, schedule = loop.load(settings)
    start = jax.jit(partial(seeds.init, program))
    keys = jax.vmap(jax.random.key)(np.array(seeds.numbers(settings), np.uint32))
    lines = []
    *timing, _ = measure(partial(_physics, program), start(schedule).arenas, keys)
    lines.append(_line(program, "physics", CONTROL_STEPS, timing, None))
    arenas = start(schedule).arenas
    *timing, _ = measure(partial(_environments, program), arenas, (schedule, keys))
    steps = _rollouts(settings) * settings.algo.rollout
    lines.append(_line(program, "environment", steps, timing, None))
    per_update = settings.seeds * settings.arenas * settings.algo.rollout
    rate = lines[-1]["arena_steps_per_s"] / per_update
    n = int(np.clip(TRAIN_SECONDS * rate / 2, 1, settings.updates))
    train = partial(seeds.train_chunk, program, schedule)
    *timing, metrics = measure(train, start(schedule), np.int32(n))
    transitions = float(np.sum(np.asarray(metrics["transitions"], np.float64)[:, :n]))
    lines.append(_line(program, "training", n * settings.algo.rollout, timing, transitions))
    return lines


def _physics(program: Program, arenas: EnvState, keys: Array) -> tuple[EnvState, Array]:
    """`physics_alone` for all seeds."""
    return seeds.each(program.config, lambda lane: physics_alone(program, *lane), (arenas, keys))


def _environments(
    program: Program, arenas: EnvState, argument: tuple[curriculum.Schedule, Array]
) -> tuple[EnvState, Array]:
    """`environment` for all seeds."""
    schedule, keys = argument
    step = partial(environment, program, schedule)
    return seeds.each(program.config, lambda lane: step(*lane), (arenas, keys))


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = config.load_train(["stage=s6", *arguments])
    settings = replace(settings, stage=settings.stage[-1:])
    for line in results(settings):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("steps_per_second", main, TrainConfig))
