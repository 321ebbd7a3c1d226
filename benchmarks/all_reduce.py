"""How long does a sum over devices take?

`python -m benchmarks.all_reduce devices=N [sizes=1,1024,16384,1048576]` sums float32 arrays over
the first N devices. One compiled program runs `SUMS` sums in sequence. For each size the command
prints a JSON line with the microseconds per sum, which is the median over `REPEATS` calls.
"""

import json
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec

from benchmarks import key_value, timing
from benchmarks.steps_per_second import made_with
from swarmjax import command
from swarmjax.config import Section, about
from swarmjax.shards import AXIS
from swarmjax.training import mesh

SUMS = 200  # sums per call
REPEATS = 7


@dataclass(frozen=True, kw_only=True)
class AllReduceConfig(Section):
    """Settings: the number of devices, and the sizes of the arrays to sum."""

    devices: int = field(default=2, metadata=about("that sum", 2, 2**16))
    sizes: tuple[int, ...] = field(
        default=(1, 1024, 16_384, 1_048_576), metadata=about("numbers per array", 1, 2**30)
    )


def seconds(devices: int, size: int) -> float:
    """Times the sum of an array over devices.

    Args:
      devices: number of devices.
      size: how many numbers the array has.

    Returns:
      Seconds per sum.
    """

    def sums(x: Array) -> Array:
        def body(x: Array, _: None) -> tuple[Array, None]:
            return jax.lax.psum(x, AXIS) / devices, None

        return jax.lax.scan(body, x, length=SUMS)[0]

    everywhere = PartitionSpec()
    call = jax.jit(
        jax.shard_map(
            sums,
            mesh=mesh.make(devices),
            in_specs=everywhere,
            out_specs=everywhere,
            check_vma=False,
        )
    )
    x = jnp.ones(size, jnp.float32)
    taken = timing.time_calls(lambda: jax.block_until_ready(call(x)), REPEATS)
    return statistics.median(taken) / SUMS


def lines(given: AllReduceConfig) -> Iterator[dict[str, Any]]:
    """Times all sizes; yields one line per size."""
    for size in given.sizes:
        yield {
            "benchmark": "all_reduce",
            "devices": given.devices,
            "bytes": 4 * size,
            "microseconds": round(1e6 * seconds(given.devices, size), 2),
            **made_with(),
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    for line in lines(key_value.load(AllReduceConfig, arguments)):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("all_reduce", main, AllReduceConfig))
