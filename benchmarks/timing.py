"""Timed calls, and compiled programs whose compile time and memory are kept apart from them."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from swarmjax.training import loop

REPEATS = 5


class TimedProgram(NamedTuple):
    """A compiled `(state, argument) -> (state, rest)`, the state donated.

    Attributes:
      call: the program.
      compile_s: seconds that tracing and compiling took.
      size: bytes of device memory that a call needs, arguments and results counted, by XLA's own
        analysis; what Warp allocates for itself is not in it.
    """

    call: Callable[[Any, Any], tuple[Any, Any]]
    compile_s: float
    size: int


def compile_program(call: Callable[[Any, Any], Any], state: Any, argument: Any) -> TimedProgram:
    """Compiles ahead of time.

    Args:
      call: `(state, argument) -> (state, rest)`.
      state: what it takes, or its shapes.
      argument: likewise.

    Returns:
      The program.
    """
    began = time.perf_counter()
    lowered = jax.jit(call, donate_argnums=0).lower(state, argument)
    compiled = lowered.compile(loop.compiler_options())
    seconds = time.perf_counter() - began
    memory = compiled.memory_analysis()
    assert memory is not None  # both CPU and GPU tell
    size = memory.argument_size_in_bytes + memory.temp_size_in_bytes
    size += memory.output_size_in_bytes - memory.alias_size_in_bytes
    return TimedProgram(compiled, seconds, size)


def time_program(
    program: TimedProgram, state: Any, argument: Any, repeats: int = REPEATS
) -> tuple[list[float], Any]:
    """Times calls, each on the state that the one before left, after one that is not counted.

    Args:
      program: what to call.
      state: to begin with; donated.
      argument: of every call.
      repeats: calls that are timed.

    Returns:
      Seconds of each call, and what the last one returned besides the state.
    """
    taken, rest = [], None
    for _ in range(1 + repeats):
        began = time.perf_counter()
        state, rest = program.call(state, argument)
        jax.block_until_ready((state, rest))
        taken.append(time.perf_counter() - began)
    return taken[1:], rest


def time_calls(call: Callable[[], Any], repeats: int = REPEATS) -> list[float]:
    """Times a call that waits for its own end, after one that is not counted.

    Args:
      call: what is timed.
      repeats: how often.

    Returns:
      Seconds of each.
    """
    taken = []
    for _ in range(1 + repeats):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return taken[1:]


def spread(calls_s: list[float]) -> dict[str, Any]:
    """The fields of a line that say how calls differed: all of them, and their median."""
    return {"calls_s": calls_s, "call_s": statistics.median(calls_s)}


def matmul_precision() -> str:
    """What JAX's matrix products are computed in: `default` may be TF32 on a GPU."""
    return jax.config.jax_default_matmul_precision or "default"
