"""Checks when checkpoints are due and training stops, and that groups of seeds run at once."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.run import trainer
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import RunConfig
from swarmjax.run.signals import Stop


def test_groups_are_called_at_once_and_keep_their_order() -> None:
    together = threading.Barrier(3, timeout=60)  # raises unless three calls run at once

    def call(schedule: Any, part: jax.Array, n: np.int32) -> tuple[jax.Array, dict]:
        together.wait()
        return part + n, {"seed": 10 * part}

    schedule: Any = None
    lanes: Any = jnp.arange(6)
    found = trainer._call_at_once(call, 3, schedule, lanes, np.int32(100))
    state: Any = found[0]
    metrics = found[1]
    assert state.tolist() == [100, 101, 102, 103, 104, 105]
    assert metrics["seed"].tolist() == [0, 10, 20, 30, 40, 50]


def _tally(update: int) -> trainer.Tally:
    """Returns the tally after this many updates of 10 ms each."""
    return trainer.Tally(update, 0, 0.0, {}, {}, seconds=0.01 * update)


def _saves_each_90() -> trainer.Saves:
    """Returns the saves of a run of 900 updates, with one checkpoint every 90 updates."""
    settings = load_train(["stage=s1", "arenas=32", f"budget={900 * 32 * 32}"])
    run = RunConfig(checkpoint_minutes=99.0)
    return trainer.Saves(replace(settings, run=run), 0)


@pytest.mark.parametrize(
    ("write_seconds", "begun"),
    [
        (0.0, 90),  # waiting for one more call would give 100
        (0.2, 70),  # a write lasts as long as 20 updates: 70 + 20 is 90
        (9.0, 50),  # no earlier than after half of the interval
    ],
)
def test_a_checkpoint_is_begun_so_early_that_a_kill_repeats_one_interval(
    write_seconds: float, begun: int
) -> None:
    saves = _saves_each_90()
    calls = range(10, 100, 10)
    assert next(n for n in calls if saves.due(_tally(n), write_seconds)) == begun


def test_a_run_waits_for_a_checkpoint_that_is_not_written_within_the_interval() -> None:
    saves = _saves_each_90()
    begun = [n for n in range(10, 60, 10) if saves.due(_tally(n), write_seconds=9.0)]
    assert begun == [50]  # the previous checkpoint is at update 0
    waits = [
        n
        for n in range(60, 100, 10)
        if not saves.due(_tally(n), 0.0) and saves.must_wait(_tally(n))
    ]
    assert waits == [90]  # another call would end at update 100


def test_a_stop_has_a_time_of_its_own() -> None:
    assert not Stop().asked
    assert not Stop(until=time.monotonic() + 3600.0).asked
    over = Stop(until=time.monotonic())
    assert over.asked
    assert not over.signalled


def test_a_call_of_all_updates_lasts_ten_seconds_so_that_a_signal_is_heard() -> None:
    settings = load_train(["stage=s1", "arenas=32", f"budget={900 * 32 * 32}", "run.chunk=all"])
    program: Any = SimpleNamespace(config=settings, rows=settings.updates)
    tally = trainer.Tally(0, 0, 0.0, {}, {}, seconds=0.0)
    calls = trainer._calls(program, tally, Stop())
    tally.update = next(calls)
    tally.seconds = 1.0 * tally.update
    assert next(calls) == 10
