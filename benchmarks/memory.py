"""How many bytes does an arena take on the GPU, and where?

`python -m benchmarks.memory arenas=65536 [key=value ...]` takes the keys of `swarmjax.train`,
trains for two updates and prints a JSON line with four numbers. They are the bytes in XLA's
analysis of the compiled program, the peak of XLA's allocator, the peak of Warp's own allocator, and
the drop in the GPU's free memory. XLA does not see what Warp allocates.

A peak covers a whole process, so measure one size per process. Set
XLA_PYTHON_CLIENT_PREALLOCATE=false; otherwise the last number is the memory that XLA preallocates.
On a CPU only the analysis is known.
"""

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks import peers, steps_per_second, timing
from swarmjax import command
from swarmjax.run.settings import TrainConfig, load_train
from swarmjax.sim import dispatch
from swarmjax.training import program as programs
from swarmjax.training import seeds

_UPDATES = 2


def result(settings: TrainConfig) -> dict[str, Any]:
    """Trains for two updates; returns the line."""
    free = free_bytes()
    program, schedule = programs.load(settings)
    init = partial(seeds.init, program)
    train = partial(seeds.train_chunk, program, schedule)
    template = jax.eval_shape(init, schedule)
    compiled = timing.compile_program(train, template, np.int32(1))
    state = jax.jit(init)(schedule)
    state_bytes = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(template))
    jax.block_until_ready(compiled.call(state, np.int32(_UPDATES)))
    statistics = jax.devices()[0].memory_stats() or {}
    left = free_bytes()
    return {
        "benchmark": "memory",
        **steps_per_second.about(settings),
        "state_bytes": state_bytes,
        "program_bytes": compiled.size,
        "peak_bytes": statistics.get("peak_bytes_in_use"),
        "warp_bytes": warp_bytes(settings),
        "device_bytes": None if free is None or left is None else free - left,
        "compile_s": compiled.compile_s,
        **steps_per_second.made_with(),
    }


def free_bytes() -> int | None:
    """Returns the free memory of the first NVIDIA GPU from Warp; None without GPU or Warp."""
    card = _card()
    return None if card is None else int(card.free_memory)


def warp_bytes(settings: TrainConfig) -> int | None:
    """Returns the peak memory of Warp's allocator; None if it is not used."""
    card = _card()
    if card is None or dispatch.resolve_impl(settings.sim.impl) != "warp":
        return None
    import warp

    return int(warp.get_mempool_used_mem_high(card))


def _card() -> Any:
    """Returns Warp's first CUDA device; None without CUDA or Warp."""
    if importlib.util.find_spec("warp") is None:
        return None
    import warp

    warp.config.log_level = warp.LOG_ERROR
    return warp.get_device("cuda:0") if warp.is_cuda_available() else None


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = load_train(["stage=s6", "budget=1e10", *arguments])
    peers.write([result(replace(settings, stage=settings.stage[-1:]))])
    return 0


if __name__ == "__main__":
    sys.exit(command.run("memory", main, TrainConfig))
