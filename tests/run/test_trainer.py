"""When training stops by itself, and groups of seeds that are called at once."""

import threading
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.run import trainer
from swarmjax.run.signals import Stop


def test_groups_are_called_at_once_and_keep_their_order() -> None:
    together = threading.Barrier(3, timeout=60)  # breaks unless all three are under way

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


def test_a_stop_has_a_time_of_its_own() -> None:
    assert not Stop().asked
    assert not Stop(until=time.monotonic() + 3600.0).asked
    over = Stop(until=time.monotonic())
    assert over.asked
    assert not over.signalled
