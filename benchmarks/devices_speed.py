"""How much faster do several devices train than one?

`python -m benchmarks.devices_speed devices=N [scaling=weak|strong] [key=value ...]` takes the keys
of `swarmjax.train` and trains alternately on one device and on N devices. `scaling=weak` gives each
device `arenas` arenas. `scaling=strong` spreads `arenas` arenas over all devices. The command
prints a JSON line with the arena steps per second in both cases, and with the ratio of the two
speeds. The line's `efficiency` is this ratio divided by N. Each number is the median over `PAIRS`
pairs. The ratio and the efficiency also have a 95 % interval by order statistics. Compile time is
listed separately.

With `run.coordinator`, `run.processes` and `run.process`, start the command once for each process.
The first process then trains alternately on its own device and on all devices, and prints the line.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from jax.experimental import multihost_utils

from benchmarks import key_value
from benchmarks.pairs import Arm, in_turn, median
from benchmarks.steps_per_second import about as about_run
from benchmarks.steps_per_second import made_with
from swarmjax import command
from swarmjax.config import ConfigError, Section, about
from swarmjax.run import hosts
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig

PAIRS = 10
OTHER_SUMS = 5  # sums over devices per update, other than those of minibatches
CALL_SECONDS = 0.8  # approximate time per call on one device


@dataclass(frozen=True, kw_only=True)
class DevicesConfig(Section):
    """Settings: what stays fixed when devices are added."""

    scaling: Literal["weak", "strong"] = field(
        default="weak", metadata=about("weak: arenas of each device; strong: arenas of all devices")
    )


def parse(words: Sequence[str]) -> tuple[DevicesConfig, TrainConfig, TrainConfig]:
    """Makes the settings of the comparison, for one device and for all devices.

    Args:
      words: words of the command line.

    Returns:
      The comparison, the settings for one device, and the settings for all devices.

    Raises:
      ConfigError: if a word is invalid, or there is only one device.
    """
    given, rest = key_value.parse(DevicesConfig, words)
    every = load_train(["stage=s6", "budget=1e11", *rest])
    if every.devices == 1:
        raise ConfigError("devices is 1: give at least 2 to compare one device with.")
    one = replace(every, devices=1, streams=1)
    if given.scaling == "weak":
        every = replace(every, arenas=every.arenas * every.devices)
    return given, one, every


def result(given: DevicesConfig, one: TrainConfig, every: TrainConfig) -> dict[str, Any] | None:
    """Compiles both programs and times them alternately.

    Args:
      given: the comparison.
      one: settings for one device.
      every: settings for all devices.

    Returns:
      The JSON line; None in all processes except the first.
    """
    alone, spread = (Arm(one) if hosts.is_first() else None), Arm(every)
    updates = _updates(alone)
    one_call, other_call = partial(_speed, alone, updates), partial(_speed, spread, updates)
    _, *pairs = in_turn(one_call, other_call, 1 + PAIRS)  # the first pair is a warm-up
    if alone is None:
        return None
    return _line(given, alone, spread, updates, pairs)


def _line(
    given: DevicesConfig, alone: Arm, spread: Arm, updates: int, pairs: list[tuple[float, float]]
) -> dict[str, Any]:
    """Summarises the timed pairs as a JSON line."""
    one, every = alone.settings, spread.settings
    ratio, low, high = median([many / single for single, many in pairs])
    return {
        "benchmark": "devices_speed",
        "scaling": given.scaling,
        "processes": hosts.count(),
        **about_run(one),
        "devices": every.devices,
        "arenas_in_all": every.arenas,
        "updates": updates,
        "sums": every.algo.num_minibatches * every.algo.epochs + OTHER_SUMS,
        "pairs": PAIRS,
        "ratio": [ratio, low, high],
        "efficiency": [value / every.devices for value in (ratio, low, high)],
        "arena_steps_per_s_of_one": median([single for single, _ in pairs])[0],
        "arena_steps_per_s": median([many for _, many in pairs])[0],
        "arena_steps_per_s_by_pair": [[round(value) for value in pair] for pair in pairs],
        "compile_s_of_one": alone.compile_s,
        "compile_s": spread.compile_s,
        **made_with(),
    }


def _updates(alone: Arm | None) -> int:
    """Chooses the number of updates per call, the same in all processes."""
    updates = 1
    if alone is not None:
        alone.time(1)
        updates = max(1, round(CALL_SECONDS / alone.time(1)))
    return int(hosts.share(updates)[0])


def _speed(arm: Arm | None, updates: int) -> float:
    """Returns the arena steps per second of one call; NaN in a process without the arm."""
    if hosts.count() > 1:
        multihost_utils.sync_global_devices("before a call")
    if arm is None:
        return np.nan
    seconds = arm.time(updates)
    settings = arm.settings
    steps = updates * settings.seeds * settings.arenas * settings.algo.rollout_length
    return steps / seconds


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given, one, every = parse(arguments)
    hosts.join(every)
    line = result(given, one, every)
    if line is not None:
        sys.stdout.write(json.dumps(line) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("devices_speed", main, TrainConfig))
