"""How much GPU memory does an arena take, and which allocator holds it?

`python -m benchmarks.memory arenas=65536 [key=value ...]` takes the keys of `swarmjax.train`,
trains for two updates and prints a JSON line with four sizes in bytes. They are the memory that the
compiled program needs by XLA's analysis, the peak of XLA's allocator, the peak of Warp's own
allocator, and the drop in the GPU's free memory. XLA's sizes do not include Warp's allocations.

A peak covers a whole process, so measure one size per process. Set
XLA_PYTHON_CLIENT_PREALLOCATE=false; otherwise the last size is the memory that XLA preallocates.
On a CPU only the size in XLA's analysis is available.
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
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch
from swarmjax.training import program as programs
from swarmjax.training import seeds

_UPDATES = 2


def result(settings: TrainConfig) -> dict[str, Any]:
    """Trains for two updates and returns the JSON line."""
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
    """Asks Warp for the free bytes of the first NVIDIA GPU; None without a GPU or without Warp."""
    card = _card()
    return None if card is None else int(card.free_memory)


def warp_bytes(settings: TrainConfig) -> int | None:
    """Returns the peak bytes of Warp's allocator; None if training does not use Warp on a GPU."""
    card = _card()
    if card is None or dispatch.resolve_impl(settings.sim.impl) != "warp":
        return None
    import warp

    return int(warp.get_mempool_used_mem_high(card))


def _card() -> Any:
    """Returns Warp's first CUDA device; None without CUDA or without Warp."""
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
