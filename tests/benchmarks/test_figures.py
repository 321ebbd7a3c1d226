"""Checks that speeds are the number of steps divided by the seconds that a fake clock shows."""

import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import steps_per_second, timing
from benchmarks.steps_per_second import Prepared
from swarmjax.run.compiled import Compiled
from swarmjax.run.run import Run
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import physics
from swarmjax.task import env
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.task.world import World
from swarmjax.training import loop, mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.rollout import Program

Line = dict[str, Any]

# Sizes of the tiny configuration, whose last stage has three robots. The other numbers below are
# chosen here.
ARENAS, ROBOTS, ROLLOUT = 8, 3, 8
SEEDS, SUBSTEPS = 2, 5
CONTROL_STEPS = steps_per_second.CONTROL_STEPS["planar"]  # Per call of physics or environment.
CALLS = [100.0, 4.0, 2.0, 1.0, 2.0, 3.0]  # Seconds; the first call is not counted.
MEDIAN = 2.0  # Seconds of a counted call.


@pytest.fixture
def pass_time(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Replaces the clock by one that stands still; returns a function that lets seconds pass."""
    now = [1000.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def go_on(seconds: float) -> None:
        now[0] += seconds

    return go_on


@pytest.fixture(scope="module")
def program(tiny_config: TrainConfig, tiny_world: World) -> Program:
    config = replace(
        tiny_config,
        seeds=SEEDS,
        sim=replace(tiny_config.sim, substeps=SUBSTEPS),
        run=replace(tiny_config.run, chunk=2, tensorboard=False),
        budget=ARENAS * ROLLOUT * 2,  # two updates of each seed
    )
    return programs.build(config, tiny_world)


class Calls(NamedTuple):
    """Stand-ins for the compiled programs, and the arguments with which they were called."""

    prepared: Prepared
    arguments: list[Any]


@pytest.fixture
def calls(program: Program, pass_time: Callable[[float], None]) -> Calls:
    """Returns stand-ins for all three programs that only let time pass."""
    taken: Iterator[float] = iter(CALLS)
    arguments = []

    def call(state: Any, argument: Any) -> tuple[Any, Any]:
        arguments.append(argument)
        pass_time(next(taken))
        return state, {
            "transitions": np.full((SEEDS, 1000), 7.0),
            "episodes_ended": np.full(SEEDS, 3),
        }

    stub = timing.TimedProgram(call, compile_s=0.0, size=0)
    prepared = Prepared(
        program=program,
        schedule=programs.schedule(program.config),
        start=lambda _: SimpleNamespace(arenas=()),
        keys=jnp.zeros(SEEDS),
        physics=stub,
        environment=stub,
        training=stub,
    )
    return Calls(prepared, arguments)


def _assert_speeds(line: Line, control_steps: int) -> None:
    """Checks the speeds of a call that made `control_steps` control steps in every arena."""
    arena_steps = SEEDS * ARENAS * control_steps
    assert line["arena_steps_per_s"] == arena_steps / MEDIAN
    assert line["robot_steps_per_s"] == arena_steps * ROBOTS / MEDIAN
    assert line["physics_steps_per_s"] == arena_steps * SUBSTEPS / MEDIAN


@pytest.mark.parametrize(
    "measure", [steps_per_second.time_physics, steps_per_second.time_environment]
)
def test_speeds_are_the_steps_of_a_call_by_its_seconds(
    measure: Callable[[Prepared, Any], Line], calls: Calls
) -> None:
    line = measure(calls.prepared, ())
    assert line["calls_s"] == CALLS[1:]
    _assert_speeds(line, CONTROL_STEPS)


def test_speeds_of_training_are_those_of_the_updates_that_were_asked_for(calls: Calls) -> None:
    line = steps_per_second.time_training(calls.prepared, arena_steps_per_s=1000.0)
    (updates,) = {int(n) for n in calls.arguments}
    _assert_speeds(line, updates * ROLLOUT)
    assert line["transitions_per_s"] == SEEDS * updates * 7.0 / MEDIAN


def _begun(program: Program) -> EnvState:
    """Returns arenas full of zeros, in the shapes of arenas that have just begun."""
    shapes = jax.eval_shape(
        functools.partial(loop.init, program, programs.schedule(program.config))
    )
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes.arenas)


def test_a_call_of_the_environment_makes_the_steps_that_are_counted(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    def step(world: World, state: EnvState, action: Any) -> tuple[EnvState, TimeStep]:
        """Only counts the step in the clock."""
        nothing, no = jnp.zeros(ROBOTS), jnp.zeros(ROBOTS, bool)
        done = jnp.zeros((), bool)
        came = TimeStep(state.observation, nothing, no, no, no, done, ~done, jnp.zeros(0))
        return replace(state, clock=state.clock + 1), came

    monkeypatch.setattr(env, "step", step)
    schedule = programs.schedule(program.config)
    arenas = _begun(program)
    call = jax.jit(functools.partial(steps_per_second.environment, program, schedule))
    after, _ = call(arenas, jax.random.key(1))
    assert after.clock.tolist() == [CONTROL_STEPS] * ARENAS


def test_a_call_of_the_physics_makes_the_steps_that_are_counted(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    def step(_: physics.Physics, data: Any, *__: Any) -> Any:
        """Only counts the step in the positions."""
        return data.replace(qpos=data.qpos + 1.0)

    monkeypatch.setattr(physics, "step", step)
    arenas = _begun(program)
    call = jax.jit(functools.partial(steps_per_second.physics_alone, program))
    _, total = call(arenas, jax.random.key(1))
    assert total == CONTROL_STEPS * arenas.sim.qpos.size


@pytest.mark.slow
def test_resets_fall_into_the_calls_that_are_timed(tiny_config: TrainConfig) -> None:
    prepared = steps_per_second.prepare(tiny_config)
    arenas = steps_per_second.settle(prepared)
    # Ages are spread evenly, so each arena resets once per step limit. The tiny step limit has
    # fewer control steps than a call.
    assert tiny_config.task.step_limit < CONTROL_STEPS
    line = steps_per_second.time_environment(prepared, arenas)
    assert line["episodes_ended"] >= tiny_config.arenas


class _State(NamedTuple):
    """A state with only the field that the trainer reads."""

    update: jax.Array


def test_speeds_of_a_run_are_its_steps_by_the_seconds_of_a_call(
    program: Program, pass_time: Callable[[float], None], tmp_path: Path
) -> None:
    schedule = programs.schedule(program.config)
    state = jax.eval_shape(mesh.init(program), schedule)
    train = seeds.chunk(program)
    blank = jax.eval_shape(train, schedule, state, np.int32(2))[1]
    metrics = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), blank)
    metrics["mix"] += 4
    metrics["robots"] += 20  # over all arenas, in each of two updates of two seeds
    metrics["transitions"] += 100

    def call(_: Any, state: _State, n: np.int32) -> tuple[_State, dict]:
        pass_time(MEDIAN)
        return _State(state.update + n), metrics

    shown: list[Line] = []
    logger: Any = SimpleNamespace(
        name="shown", write=lambda _, speeds: shown.append(speeds), close=lambda: None
    )
    run = Run(program.config, loggers=[logger])
    run.path, run.program, run.schedule = tmp_path / "run", program, schedule
    run.compiled = Compiled(call, seconds=0.0, memory_bytes=0)
    run.state = _State(jnp.zeros(SEEDS, jnp.int32))
    run._train_chunks()
    (speeds,) = shown
    assert speeds["arena_steps_per_s"] == 2 * SEEDS * ARENAS * ROLLOUT / MEDIAN
    assert speeds["robot_steps_per_s"] == 2 * SEEDS * 20 * ROLLOUT / MEDIAN
    assert speeds["physics_steps_per_s"] == 2 * SEEDS * ARENAS * ROLLOUT * SUBSTEPS / MEDIAN
    assert speeds["transitions_per_s"] == 2 * SEEDS * 100 / MEDIAN
