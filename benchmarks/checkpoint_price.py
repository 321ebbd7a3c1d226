"""How much training speed do checkpoints cost?

`python -m benchmarks.checkpoint_price [every=S] [seconds=S] [key=value ...]` compiles the program
of a config once. The command then trains alternately with a checkpoint every `every` seconds, and
without checkpoints during training. All other keys are keys of `swarmjax.train`. The command prints
a JSON line with the arena control steps per second in both cases, and with the share of the speed
that checkpoints cost. These numbers are medians over `PAIRS` pairs of training calls. The share
also has a 95 % interval by order statistics. `price_at_60_s` is this share for one checkpoint a
minute, if each checkpoint costs the same time.
"""

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import key_value
from benchmarks.pairs import in_turn, median
from swarmjax import command, provenance
from swarmjax.config import Section, about
from swarmjax.curriculum.engine import Schedule
from swarmjax.run import checkpoint, directory, lifecycle, memory, trainer
from swarmjax.run.display import Display, Row
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop
from swarmjax.run.trainer import Built, Compiled
from swarmjax.sim import dispatch
from swarmjax.training.loop import TrainState

PAIRS = 6
WARM_UP_S = 20.0  # training before timing starts: calls grow longer, and robots learn to arrive
_NEVER = 1e6  # minutes


@dataclass(frozen=True, kw_only=True)
class PriceConfig(Section):
    """Settings: how often a checkpoint is written, and how long each training call lasts."""

    every: float = field(default=5.0, metadata=about("seconds between checkpoints", above=0.0))
    seconds: float = field(default=20.0, metadata=about("training time of each call", above=0.0))


class Clock(Display):
    """Records when the calls of a run end, and shows nothing.

    Attributes:
      ends: For each call, seconds of `time.perf_counter` and the updates done by then.
    """

    def __init__(self) -> None:
        """Starts with no records."""
        self.ends: list[tuple[float, int]] = []

    def say(self, sentence: str) -> None:
        """Shows nothing."""

    def hear(self, rows: Sequence[Row], speeds: Row) -> None:
        """Records the end of a call."""
        self.ends.append((time.perf_counter(), rows[-1]["update"]))

    def show(self, summary: Row, speeds: Row, seconds_left: float) -> None:
        """Shows nothing."""

    def updates_per_s(self) -> float:
        """Computes the speed from the end of the first call to the end of the last call."""
        (began, first), (ended, last) = self.ends[0], self.ends[-1]
        return (last - first) / (ended - began)


@dataclass(frozen=True)
class Steady:
    """A compiled program and its arguments."""

    program: Built
    schedule: Schedule
    compiled: Compiled
    state: TrainState

    def train(self, minutes: float, seconds: float) -> tuple[float, int]:
        """Trains a copy of the state; returns updates per second and the number of checkpoints.

        The number does not include the first and the last checkpoint.
        """
        clock, config = Clock(), self.program.config
        run = replace(config.run, checkpoint_minutes=minutes, checkpoint_share=0.0)
        program = replace(self.program, config=replace(config, run=run))
        copy = jax.tree.map(jnp.copy, self.state)
        with tempfile.TemporaryDirectory() as folder:
            place, stop = Path(folder) / "run", Stop(until=time.monotonic() + seconds)
            place.mkdir()
            directory.write_json(place / directory.CONFIG, {})
            trainer.train(place, program, self.schedule, self.compiled, copy, clock, stop)
            saved = directory.read_rows(place / directory.SAVED, None)
        # Both cases write the first and the last checkpoint, so these two do not count.
        return clock.updates_per_s(), len(saved) - 2


def load(settings: TrainConfig) -> Steady:
    """Compiles a config's program and trains for `WARM_UP_S`, until the speed is steady."""
    program, schedule, state = lifecycle.begin(settings)
    compiled, state = trainer.prepare(program, schedule, state, memory.limit())
    began = time.perf_counter()
    while time.perf_counter() - began < WARM_UP_S:
        state, _ = jax.block_until_ready(compiled.call(schedule, state, jnp.int32(1)))
    return Steady(program, schedule, compiled, state)


def result(config: PriceConfig, settings: TrainConfig) -> dict[str, Any]:
    """Trains alternately with and without checkpoints; returns the JSON line."""
    steady = load(settings)
    found = in_turn(
        lambda: steady.train(config.every / 60.0, config.seconds),
        lambda: steady.train(_NEVER, config.seconds),
        PAIRS,
    )
    pairs = [(saving, free) for (saving, _), (free, _) in found]
    price, low, high = median([1.0 - saving / free for saving, free in pairs])
    steps = settings.arenas * settings.algo.rollout_length
    leaves = checkpoint.to_leaves(steady.state)
    written = sum(count for (_, count), _ in found)
    apart_s = PAIRS * config.seconds / max(1, written)
    return {
        "benchmark": "checkpoint_price",
        "every_s": config.every,
        "price": price,
        "price_low": low,
        "price_high": high,
        "price_at_60_s": price * apart_s / 60.0,
        "price_at_60_s_high": high * apart_s / 60.0,
        "pairs": PAIRS,
        "seconds": config.seconds,
        "checkpoints": written,
        "checkpoint_mb": sum(leaf.nbytes for leaf in leaves.values()) / 1e6,
        "arena_steps_per_s": median([saving for saving, _ in pairs])[0] * steps,
        "arena_steps_per_s_without": median([free for _, free in pairs])[0] * steps,
        "arenas": settings.arenas,
        "robot": settings.robot.body,
        "stages": settings.stage_names,
        "compile_s": steady.compiled.seconds,
        "impl": dispatch.resolve_impl(settings.sim.impl),
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    config, words = key_value.parse(PriceConfig, arguments)
    settings = load_train(["stage=s6", "run.tensorboard=false", *words])
    sys.stdout.write(json.dumps(result(config, settings)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("checkpoint_price", main, TrainConfig))
