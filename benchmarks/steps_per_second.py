"""How many steps per second do physics alone, the environment and training reach?

`python -m benchmarks.steps_per_second [key=value ...]` takes the keys of `swarmjax.train`. Several
numbers of arenas are separated by commas, as in `arenas=1024,65536`. For every number of arenas it
prints a JSON line for physics alone, for the environment including physics, and for training
including both. Each speed is the median of `timing.REPEATS` timed calls after a warm-up call.
Compile time is listed separately.

For physics and environment, all robots of the last stage take random actions. For training, robots
take the policy's actions. Before environment and physics are timed, the environment runs for a
whole episode, in which the arenas' clocks start spread over the step limit. Arenas are then at all
points of an episode, and some of them reset in every timed call. `episodes_ended` counts the resets
in the last call. Speeds are totals over all `seeds`. If a device runs out of memory, the line gives
the reason as `failed`.
"""

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

from benchmarks import lines, timing
from swarmjax import command
from swarmjax.curriculum.engine import Schedule
from swarmjax.ppo.memory import NO_MEMORY
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch, drive, physics
from swarmjax.sim.config import physics_substeps
from swarmjax.task import env
from swarmjax.task.env import EnvState
from swarmjax.training import mesh, rollout, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Program

# Control steps per call of physics and environment: whole rollouts of the default algorithm.
CONTROL_STEPS = {"planar": 64, "wheeled": 32}
TRAIN_SECONDS = 1.0  # s; approximate time of a call of training
THREADS = 4  # sizes compiled in parallel
# Every line has these entries. The lines of peers have entries with the same names.
COUNTED = {
    "step": "control step: command, rigid bodies with contacts, 8 infrared rays, reward",
    "resets": "at once, each on a fresh random level that was drawn ahead of the rollout",
    "precision": "float32",
}


@dataclass(frozen=True, eq=False)
class Prepared:
    """The programs of one size, compiled but not yet run.

    Attributes:
      program: the parts of training that are fixed at compile time.
      schedule: the curriculum's stages, deadlines and thresholds, an argument of all programs.
      start: makes the first state from the schedule.
      keys: [N] a random key for each seed.
      physics: program that steps the physics alone.
      environment: program that steps the environment.
      training: program that trains.
    """

    program: Program
    schedule: Schedule
    start: Any
    keys: Array
    physics: timing.TimedProgram
    environment: timing.TimedProgram
    training: timing.TimedProgram


def prepare(settings: TrainConfig) -> Prepared:
    """Compiles all programs of one size; threads may prepare several sizes in parallel."""
    program, schedule = programs.load(settings)
    init = mesh.init(program)
    template: TrainState = jax.eval_shape(init, schedule)
    keys = jax.vmap(jax.random.key)(np.array(settings.numbers, np.uint32))
    train = partial(seeds.chunk(program), schedule)
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
    """Steps the physics of all arenas with random commands.

    Returns:
      The unchanged arenas, so that each timed call does the same work, and a number that depends on
      every result.
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
    """Steps all arenas with random actions, including resets.

    Returns:
      The arenas, and the sums of `reward` and `episodes_ended`. The sum of `reward` includes the
      observations, so that the compiler cannot remove them.
    """
    world = program.world
    step = jax.vmap(partial(env.step, world))
    unpack = jax.vmap(partial(physics.unpack, world.physics))

    def body(arenas: rollout.Arena, key: Array, starts: rollout.Arena) -> tuple[Any, Any]:
        arenas, came = step(arenas, _actions(program, key))
        # A sum over all arenas in every step would be a kernel with a single block.
        reward = jnp.sum(came.reward, axis=-1) + jnp.sum(came.observation, axis=(-2, -1))
        sums = {"reward": reward, "episodes_ended": came.done.astype(jnp.int32)}
        return rollout.restart(arenas, starts, came.done), sums

    def rolled(arenas: rollout.Arena, key: Array) -> tuple[Any, Any]:
        level_key, key = jax.random.split(key)
        index = jnp.zeros((1, program.config.arenas), jnp.int32)
        starts = rollout.draw_starts(world, schedule.stages, index, jnp.int32(0), level_key)
        keys = jax.random.split(key, program.config.algo.rollout_length)
        return jax.lax.scan(partial(body, starts=starts), arenas, keys)

    began = replace(arenas, sim=unpack(arenas.sim), recall=NO_MEMORY)  # random: no memory
    keys = jax.random.split(key, _rollouts(program.config))
    ended, sums = jax.lax.scan(rolled, began, keys)
    packed = jax.vmap(physics.pack)(ended.sim)
    return replace(ended, sim=packed, recall=arenas.recall), jax.tree.map(jnp.sum, sums)


def _rollouts(settings: TrainConfig) -> int:
    """Returns the number of rollouts per call of the environment."""
    return max(1, CONTROL_STEPS[settings.robot.body] // settings.algo.rollout_length)


def _actions(program: Program, key: Array) -> Array:
    """Draws uniform random actions [A, R, U]."""
    shape = (program.config.arenas, program.config.sim.max_robots, drive.ACTION_SIZE)
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _line(
    prepared: Prepared,
    name: str,
    control_steps: int,
    calls_s: list[float],
    transitions: float | None = None,
) -> dict[str, Any]:
    """Makes a result line whose entries have the names in docs/interface.md."""
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
        **lines.made_with(),
    }


def about(settings: TrainConfig, impl: str | None = None) -> dict[str, Any]:
    """Returns the entries of a result line that describe the simulation and what a step includes.

    Args:
      settings: settings of training.
      impl: implementation that was used; None: found from the settings, which may use the GPU.

    Returns:
      Entries with the names in docs/interface.md.
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


def settle(prepared: Prepared) -> rollout.Arena:
    """Steps the environment until its arenas are at all points of an episode.

    Returns:
      The arenas after at least one step limit. The arenas' clocks started evenly spread over the
      step limit.
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
    """Times the physics alone; returns the JSON line. The arenas' buffers are donated."""
    calls_s, _ = timing.time_program(prepared.physics, arenas, prepared.keys)
    steps = CONTROL_STEPS[prepared.program.config.robot.body]
    return _line(prepared, "physics", steps, calls_s)


def time_environment(prepared: Prepared, arenas: rollout.Arena) -> dict[str, Any]:
    """Times the environment; returns the JSON line. The arenas' buffers are donated."""
    settings = prepared.program.config
    argument = prepared.schedule, prepared.keys
    calls_s, sums = timing.time_program(prepared.environment, arenas, argument)
    steps = _rollouts(settings) * settings.algo.rollout_length
    line = _line(prepared, "environment", steps, calls_s)
    return line | {"episodes_ended": int(np.sum(sums["episodes_ended"]))}


def time_training(prepared: Prepared, arena_steps_per_s: float) -> dict[str, Any]:
    """Times training over at least an episode, since steps become slower within an episode.

    The environment's speed determines the number of updates per call.

    Args:
      prepared: the compiled programs of one size.
      arena_steps_per_s: speed of the environment; training is assumed to be half as fast.

    Returns:
      The line.
    """
    settings = prepared.program.config
    per_update = settings.seeds * settings.arenas * settings.algo.rollout_length
    updates = TRAIN_SECONDS * arena_steps_per_s / per_update / 2
    n = int(np.clip(updates, 1, prepared.program.rows))
    episode = -(-settings.task.step_limit // (n * settings.algo.rollout_length))
    repeats = max(timing.REPEATS, episode)
    state = prepared.start(prepared.schedule)
    calls_s, metrics = timing.time_program(prepared.training, state, np.int32(n), repeats)
    transitions = float(np.sum(np.asarray(metrics["transitions"], np.float64)[:, :n]))
    return _line(prepared, "training", n * settings.algo.rollout_length, calls_s, transitions)


def results(prepared: Prepared) -> list[dict[str, Any]]:
    """Runs the three benchmarks of one size; returns their lines."""
    environment = time_environment(prepared, settle(prepared))
    alone = time_physics(prepared, settle(prepared))
    training = time_training(prepared, environment["arena_steps_per_s"])
    return [alone, environment, training]


def sweep(points: Sequence[TrainConfig]) -> Iterator[list[dict[str, Any]]]:
    """Compiles all sizes, then times one size after the other; yields the lines of each size.

    Compiling takes much longer than running, so threads compile several sizes in parallel. All
    compiling is complete before the first call is timed.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        futures = [pool.submit(prepare, settings) for settings in points]
    for settings in points:
        try:
            # `pop` removes the size from the list, so that its device memory is freed.
            yield results(futures.pop(0).result())
        except jax.errors.JaxRuntimeError as error:
            reason = str(error).partition("\n")[0][:300]
            line = {"benchmark": "steps_per_second", **about(settings), "failed": reason}
            yield [line | lines.made_with()]


def _physics(program: Program, arenas: EnvState, keys: Array) -> tuple[EnvState, Array]:
    """Runs `physics_alone` for all seeds."""
    return seeds.each(lambda _, lane: physics_alone(program, *lane), None, (arenas, keys))


def _environments(
    program: Program, arenas: rollout.Arena, argument: tuple[Schedule, Array]
) -> tuple[rollout.Arena, dict[str, Array]]:
    """Runs `environment` for all seeds."""
    schedule, keys = argument
    step = partial(environment, program, schedule)
    return seeds.each(lambda _, lane: step(*lane), None, (arenas, keys))


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    sizes = [word.partition("=")[2] for word in arguments if word.startswith("arenas=")]
    words = ["stage=s6", *arguments]
    points = [
        load_train([*words, f"arenas={size}"] if sizes else words)
        for size in (sizes[-1].split(",") if sizes else [""])
    ]
    for measured in sweep([replace(point, stage=point.stage[-1:]) for point in points]):
        lines.write(measured)
    return 0


if __name__ == "__main__":
    sys.exit(command.run("steps_per_second", main, TrainConfig))
