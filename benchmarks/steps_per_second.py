"""How many steps a second: physics alone, the environment with it, training with both?

`python -m benchmarks.steps_per_second [key=value ...]` takes the keys of `swarmjax.train`, and
numbers of arenas with commas between them, as in `arenas=1024,65536`. It prints a JSON line for
each of the three at every number of arenas, the median of `timing.REPEATS` timed calls after one
that is not counted; compile time is apart. All robots of the last stage act at random (physics and
environment) or by the policy that is being trained. Before environment and physics are timed, the
environment steps for a whole episode from clocks spread over the step limit, so that arenas have
all ages and reset in every timed call; `episodes_ended` counts those of the last. Speeds are those
of all `seeds` together. What a device has no memory for gives a line that says so, as `failed`.
"""

import json
import statistics
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks import timing
from swarmjax import command, provenance
from swarmjax.curriculum.engine import Schedule
from swarmjax.run.settings import TrainConfig, load_train
from swarmjax.sim import dispatch, drive, physics
from swarmjax.sim.config import physics_substeps
from swarmjax.task import env
from swarmjax.task.env import EnvState
from swarmjax.training import program as programs
from swarmjax.training import rollout, seeds
from swarmjax.training.loop import TrainState
from swarmjax.training.program import Program

# Of one call of physics and environment; whole rollouts of the default algorithm.
CONTROL_STEPS = {"planar": 64, "wheeled": 32}
TRAIN_SECONDS = 1.0  # of one call of training, about
THREADS = 4  # sizes that are compiled side by side
# Said in every line, as peers say it in theirs.
COUNTED = {
    "step": "control step: command, rigid bodies with contacts, 8 infrared rays, reward",
    "resets": "at once, each on a fresh random level that was drawn ahead of the rollout",
    "precision": "float32",
}


@dataclass(frozen=True, eq=False)
class Prepared:
    """One size, compiled and not yet run.

    Attributes:
      program: the compiled side.
      schedule: the curriculum's numbers.
      start: makes the first state of a schedule.
      keys: [N] a random key for each seed.
      physics: steps the physics alone.
      environment: steps the environment.
      training: trains.
    """

    program: Program
    schedule: Schedule
    start: Any
    keys: Array
    physics: timing.TimedProgram
    environment: timing.TimedProgram
    training: timing.TimedProgram


def prepare(settings: TrainConfig) -> Prepared:
    """Compiles all programs of one size; several sizes may be prepared in threads."""
    program, schedule = programs.load(settings)
    init = partial(seeds.init, program)
    template: TrainState = jax.eval_shape(init, schedule)
    keys = jax.vmap(jax.random.key)(np.array(seeds.numbers(settings), np.uint32))
    train = partial(seeds.train_chunk, program, schedule)
    environments, arenas = partial(_environments, program), template.arenas
    return Prepared(
        program=program,
        schedule=schedule,
        start=jax.jit(init).lower(schedule).compile(),
        keys=keys,
        physics=timing.compile_program(partial(_physics, program), arenas, keys),
        environment=timing.compile_program(environments, arenas, (schedule, keys)),
        training=timing.compile_program(train, template, np.int32(1)),
    )


def physics_alone(program: Program, arenas: EnvState, key: Array) -> tuple[EnvState, Array]:
    """Moves all arenas with random commands.

    Returns:
      The arenas as they were, so that each timed call does the same work, and a number that
      depends on all of it.
    """
    world = program.world
    move = jax.vmap(partial(physics.step, world.physics))
    level = arenas.level
    data = jax.vmap(partial(physics.unpack, world.physics))(arenas.sim)

    def body(data: Any, key: Array) -> tuple[Any, None]:
        command = drive.command(_actions(program, key), world.drive, jnp)
        wheels = drive.wheel_speeds(command, world.drive, jnp)
        return move(data, level.side, level.obstacle, wheels), None

    steps = CONTROL_STEPS[program.config.robot.body]
    data, _ = jax.lax.scan(body, data, jax.random.split(key, steps))
    return arenas, jnp.sum(jax.vmap(physics.pack)(data).qpos)


def environment(
    program: Program, schedule: Schedule, arenas: rollout.Arena, key: Array
) -> tuple[rollout.Arena, dict[str, Array]]:
    """Steps all arenas with random actions, resets and all.

    Returns:
      The arenas, and the sums of `reward` (with the observations, so that none is left out) and of
      `episodes_ended`.
    """
    world = program.world
    step = jax.vmap(partial(env.step, world))
    unpack = jax.vmap(partial(physics.unpack, world.physics))

    def body(arenas: rollout.Arena, key: Array, starts: rollout.Arena) -> tuple[Any, Any]:
        arenas, came = step(arenas, _actions(program, key))
        reward = jnp.sum(came.reward) + jnp.sum(came.observation)
        sums = {"reward": reward, "episodes_ended": jnp.sum(came.done, dtype=jnp.int32)}
        return rollout.restart(arenas, starts, came.done), sums

    def rolled(arenas: rollout.Arena, key: Array) -> tuple[Any, Any]:
        level_key, key = jax.random.split(key)
        index = jnp.zeros((1, program.config.arenas), jnp.int32)
        starts = rollout.draw_starts(world, schedule.stages, index, jnp.int32(0), level_key)
        keys = jax.random.split(key, program.config.algo.rollout_length)
        return jax.lax.scan(partial(body, starts=starts), arenas, keys)

    began = replace(arenas, sim=unpack(arenas.sim), recall=None)  # who drives at random forgets
    keys = jax.random.split(key, _rollouts(program.config))
    ended, sums = jax.lax.scan(rolled, began, keys)
    packed = jax.vmap(physics.pack)(ended.sim)
    return replace(ended, sim=packed, recall=arenas.recall), jax.tree.map(jnp.sum, sums)


def _rollouts(settings: TrainConfig) -> int:
    """How many rollouts a call of the environment is."""
    return max(1, CONTROL_STEPS[settings.robot.body] // settings.algo.rollout_length)


def _actions(program: Program, key: Array) -> Array:
    """Uniform random actions [A, R, U]."""
    shape = (program.config.arenas, program.config.sim.max_robots, program.world.action_size)
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _line(
    prepared: Prepared,
    name: str,
    control_steps: int,
    calls_s: list[float],
    transitions: float | None = None,
) -> dict[str, Any]:
    """Puts a result together under the names of docs/interface.md."""
    settings, compiled = prepared.program.config, getattr(prepared, name)
    seconds = statistics.median(calls_s)
    arena_steps = control_steps * settings.seeds * settings.arenas / seconds
    count = physics_substeps(settings.robot, settings.sim.substeps)
    return {
        "benchmark": f"steps_per_second.{name}",
        **about(settings),
        "arena_steps_per_s": arena_steps,
        "robot_steps_per_s": arena_steps * settings.stage[-1].robots,
        "physics_steps_per_s": arena_steps * count,
        "transitions_per_s": None if transitions is None else transitions / seconds,
        "compile_s": compiled.compile_s,
        "program_bytes": compiled.size,
        **timing.spread(calls_s),
        **made_with(),
    }


def about(settings: TrainConfig, impl: str | None = None) -> dict[str, Any]:
    """The fields of a line that say what was simulated, and how it is counted.

    Args:
      settings: of training.
      impl: that was used; None looks for it, which takes the card if it is to be found out.

    Returns:
      Fields under the names of docs/interface.md.
    """
    return {
        "robot": settings.robot.body,
        "solver": settings.sim.solver,
        "impl": dispatch.resolve_impl(settings.sim.impl) if impl is None else impl,
        "arenas": settings.arenas,
        "devices": settings.devices,
        "seeds": settings.seeds,
        "robots": settings.stage[-1].robots,
        "obstacles": settings.stage[-1].obstacles,
        "side": settings.stage[-1].side,
        "substeps": physics_substeps(settings.robot, settings.sim.substeps),
        "control_step": settings.task.control_step,
        **COUNTED,
        "matmul_precision": timing.matmul_precision(),
    }


def made_with() -> dict[str, Any]:
    """The fields of a line that say where it was made."""
    return {
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def settle(prepared: Prepared) -> rollout.Arena:
    """Steps the environment until its arenas have all ages.

    Returns:
      The arenas, after a step limit that they began with clocks spread evenly over it.
    """
    settings = prepared.program.config
    arenas: rollout.Arena = prepared.start(prepared.schedule).arenas
    spread = jnp.linspace(0, settings.task.step_limit, arenas.clock.size, endpoint=False)
    clock = jax.random.permutation(jax.random.key(0), spread.astype(arenas.clock.dtype))
    arenas = replace(arenas, clock=clock.reshape(arenas.clock.shape))
    steps = _rollouts(settings) * settings.algo.rollout_length
    for _ in range(-(-settings.task.step_limit // steps)):
        arenas, _ = prepared.environment.call(arenas, (prepared.schedule, prepared.keys))
    return arenas


def time_physics(prepared: Prepared, arenas: EnvState) -> dict[str, Any]:
    """Times the physics alone; returns the line. The arenas are used up."""
    calls_s, _ = timing.time_program(prepared.physics, arenas, prepared.keys)
    steps = CONTROL_STEPS[prepared.program.config.robot.body]
    return _line(prepared, "physics", steps, calls_s)


def time_environment(prepared: Prepared, arenas: rollout.Arena) -> dict[str, Any]:
    """Times the environment; returns the line. The arenas are used up."""
    settings = prepared.program.config
    argument = prepared.schedule, prepared.keys
    calls_s, sums = timing.time_program(prepared.environment, arenas, argument)
    steps = _rollouts(settings) * settings.algo.rollout_length
    line = _line(prepared, "environment", steps, calls_s)
    return line | {"episodes_ended": int(np.sum(sums["episodes_ended"]))}


def time_training(prepared: Prepared, arena_steps_per_s: float) -> dict[str, Any]:
    """Times training, in calls whose length follows from the environment's speed.

    Args:
      prepared: what to run.
      arena_steps_per_s: of the environment; training is taken to be half as fast.

    Returns:
      The line.
    """
    settings = prepared.program.config
    per_update = settings.seeds * settings.arenas * settings.algo.rollout_length
    updates = TRAIN_SECONDS * arena_steps_per_s / per_update / 2
    n = int(np.clip(updates, 1, prepared.program.rows))
    state = prepared.start(prepared.schedule)
    calls_s, metrics = timing.time_program(prepared.training, state, np.int32(n))
    transitions = float(np.sum(np.asarray(metrics["transitions"], np.float64)[:, :n]))
    return _line(prepared, "training", n * settings.algo.rollout_length, calls_s, transitions)


def results(prepared: Prepared) -> list[dict[str, Any]]:
    """Runs the three benchmarks of one size; returns their lines."""
    environment = time_environment(prepared, settle(prepared))
    alone = time_physics(prepared, settle(prepared))
    training = time_training(prepared, environment["arena_steps_per_s"])
    return [alone, environment, training]


def sweep(points: Sequence[TrainConfig]) -> Iterator[list[dict[str, Any]]]:
    """Compiles all sizes, then runs one after the other; yields the lines of each.

    Compiling, not running, is what takes long; it is done in threads, and over before the first
    call is timed.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        futures = [pool.submit(prepare, settings) for settings in points]
    for settings in points:
        try:
            # Taken out of the list: what one size holds on the device is not to outlive it.
            yield results(futures.pop(0).result())
        except jax.errors.JaxRuntimeError as error:
            reason = str(error).partition("\n")[0][:300]
            line = {"benchmark": "steps_per_second", **about(settings), "failed": reason}
            yield [line | made_with()]


def _physics(program: Program, arenas: EnvState, keys: Array) -> tuple[EnvState, Array]:
    """`physics_alone` for all seeds."""
    return seeds.each(program.config, lambda lane: physics_alone(program, *lane), (arenas, keys))


def _environments(
    program: Program, arenas: rollout.Arena, argument: tuple[Schedule, Array]
) -> tuple[rollout.Arena, dict[str, Array]]:
    """`environment` for all seeds."""
    schedule, keys = argument
    step = partial(environment, program, schedule)
    return seeds.each(program.config, lambda lane: step(*lane), (arenas, keys))


def split(words: Sequence[str], key: str) -> tuple[list[str], list[str]]:
    """Takes a key with several values out of the words of a command line.

    Args:
      words: `key=value`.
      key: the one with commas in its value.

    Returns:
      Its values, none if it is not there, and the other words.
    """
    given = [word.partition("=")[2] for word in words if word.startswith(f"{key}=")]
    rest = [word for word in words if not word.startswith(f"{key}=")]
    return given[-1].split(",") if given else [], rest


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    sizes, words = split(arguments, "arenas")
    given = [[f"arenas={size}"] for size in sizes] or [[]]
    points = [load_train(["stage=s6", *words, *size]) for size in given]
    for lines in sweep([replace(point, stage=point.stage[-1:]) for point in points]):
        sys.stdout.write("".join(json.dumps(line) + "\n" for line in lines))
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("steps_per_second", main, TrainConfig))
