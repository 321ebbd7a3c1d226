"""Checks that groups of seeds run at once."""

import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.run import compiled


def test_groups_are_called_at_once_and_keep_their_order() -> None:
    together = threading.Barrier(3, timeout=60)  # raises unless three calls run at once

    def call(schedule: Any, part: jax.Array, n: np.int32) -> tuple[jax.Array, dict]:
        together.wait()
        return part + n, {"seed": 10 * part}

    schedule: Any = None
    lanes: Any = jnp.arange(6)
    found = compiled._call_at_once(call, 3, schedule, lanes, np.int32(100))
    state: Any = found[0]
    metrics = found[1]
    assert state.tolist() == [100, 101, 102, 103, 104, 105]
    assert metrics["seed"].tolist() == [0, 10, 20, 30, 40, 50]
