"""How is the time of an update divided among drawing levels, the rollout and learning?

`python -m benchmarks.update_parts [key=value ...]` takes the keys of `swarmjax.train`. It compiles
each part of an update as a program of its own, and prints a JSON line for each part. The networks
are untrained, and the arenas are on the stages on which the run begins. To begin on all stages,
give `curriculum.mode=adaptive` and no `prerequisites`. Unlike `benchmarks.profile`, it keeps all
stages, so it also shows what drawing the levels of different layouts costs.

The parts do not add up to an update exactly. They leave out the curriculum, the metrics and a
buffer of levels, and XLA optimises each program as a whole.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import jax
from jax import Array

from benchmarks import steps_per_second, timing
from swarmjax import command
from swarmjax.config import ConfigError
from swarmjax.curriculum.engine import Schedule
from swarmjax.ppo.learner import Batch, LearnerState
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.training import loop, rollout, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.program import Program
from swarmjax.training.rollout import Arena


def draw(program: Program, schedule: Schedule, state: TrainState, key: Array) -> Arena:
    """Draws the levels on which arenas start when an episode ends during a rollout."""
    return loop._draw_waiting(program, schedule, state.curriculum, key)


def collect(program: Program, state: TrainState, waiting: Arena, key: Array) -> Batch:
    """Lets all arenas drive for a rollout, and computes advantages."""
    _, trajectory, _ = rollout.collect(program, state.learners, state.arenas, waiting, key)
    return rollout.batch(trajectory, program.config.algo, program.shards, state.arenas.recall)


def learn(program: Program, state: TrainState, batch: Batch, key: Array) -> LearnerState:
    """Updates all learners."""
    return loop._learn(program, state.learners, batch, key)[0]


def results(settings: TrainConfig) -> Iterator[dict[str, Any]]:
    """Times each part of an update of all seeds; yields a line for each.

    Raises:
      ConfigError: if there are several devices.
    """
    if settings.devices > 1:
        raise ConfigError(
            f"devices is {settings.devices}: give devices=1, because the parts of one are timed."
        )
    program, schedule = programs.load(settings)
    state = jax.jit(partial(seeds.init, program))(schedule)
    key = jax.random.split(jax.random.key(settings.seed), settings.seeds)
    about = {
        "seeds": settings.seeds,
        "arenas": settings.arenas,
        "stages": len(settings.stage),
        "rollout_length": settings.algo.rollout_length,
        "waiting": settings.waiting,
        **steps_per_second.made_with(),
    }
    of_seeds = partial(_of_seeds, program)
    line, waiting = _timed("draw", of_seeds(partial(draw, program, schedule)), (state, key))
    yield line | about
    line, batch = _timed("collect", of_seeds(partial(collect, program)), (state, waiting, key))
    yield line | about
    line, _ = _timed("learn", of_seeds(partial(learn, program)), (state, batch, key))
    yield line | about


def _of_seeds(program: Program, part: Callable[..., Any]) -> Callable[..., Any]:
    """Applies a part of an update to all seeds, as training does."""

    def of_one(given: tuple) -> Any:
        return part(*given)

    return lambda *given: seeds.each(program.config, of_one, given)


def _timed(part: str, call: Callable[..., Any], given: tuple) -> tuple[dict[str, Any], Any]:
    """Compiles and times a part; returns its line and its result."""
    began = time.perf_counter()
    compiled = jax.jit(call).lower(*given).compile(loop.compiler_options())
    seconds = time.perf_counter() - began
    result = compiled(*given)
    taken = timing.time_calls(lambda: jax.block_until_ready(compiled(*given)))
    line = {
        "benchmark": "update_parts",
        "part": part,
        "ms": 1e3 * statistics.median(taken),
        "compile_s": seconds,
    }
    return line, result


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    for line in results(load_train(arguments)):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("update_parts", main, TrainConfig))
