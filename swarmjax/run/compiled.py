"""Compiles the program of a run ahead of time, and says how much memory the program needs."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from swarmjax import provenance
from swarmjax.curriculum.engine import Schedule
from swarmjax.run import traces
from swarmjax.run.settings import TrainConfig
from swarmjax.training import mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Program


@dataclass(frozen=True)
class Compiled:
    """The compiled function that trains a chunk of updates, with its compile time and memory.

    Attributes:
      call: (schedule, state [N], n) -> (state [N], metrics [N, rows]). The state is donated.
      seconds: time spent tracing and compiling.
      memory_bytes: device memory that training needs.
    """

    call: Callable[[Schedule, TrainState, np.int32], tuple[TrainState, dict]]
    seconds: float
    memory_bytes: int


def compile_chunk(
    program: Program[TrainConfig], schedule: Schedule, state: Any, *, keep_trace: bool = False
) -> Compiled:
    """Compiles `seeds.chunk` ahead of time.

    Args:
      program: the run's program.
      schedule: the curriculum's stages, deadlines and thresholds.
      state: states with a seed axis [N], or their shapes from `jax.eval_shape`.
      keep_trace: whether to keep the traced program for later runs, and to use one that was kept.

    Returns:
      The compiled function, its compile time and its memory.
    """
    began = time.perf_counter()
    groups = programs.groups(program.config, provenance.cores())
    part = jax.eval_shape(partial(seeds.split, parts=groups), state)[0]
    given, jitted = (schedule, part, np.int32(1)), mesh.jit_chunk(program)
    if keep_trace:
        jitted = traces.keep(program, "chunk", jitted, given, donated=(1,))
    lowered = jitted.lower(*given)
    fixed = program.config.run.deterministic
    call = lowered.compile(programs.compiler_options(deterministic=fixed))
    needed = call.memory_analysis()
    assert needed is not None  # JAX reports it on CPU and GPU
    # The returned state reuses the memory of the donated state. Only the metrics need more memory.
    returned = needed.output_size_in_bytes - needed.alias_size_in_bytes
    each = needed.argument_size_in_bytes + needed.temp_size_in_bytes + returned
    return Compiled(
        call=call if groups == 1 else partial(_call_at_once, call, groups),
        seconds=time.perf_counter() - began,
        memory_bytes=groups * each,
    )


def _call_at_once(
    call: Callable[..., Any], groups: int, schedule: Schedule, state: TrainState, n: np.int32
) -> tuple[TrainState, dict]:
    """Runs each group of seeds in a thread of its own, because XLA uses one core per group."""

    def one(part: TrainState) -> tuple[TrainState, dict]:
        return jax.block_until_ready(call(schedule, part, n))

    parts = jax.jit(seeds.split, static_argnums=1)(state, groups)
    with ThreadPoolExecutor(groups) as pool:
        return jax.jit(seeds.join)(list(pool.map(one, parts)))
