"""Times calls of compiled programs, and measures their compile time and memory separately."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from swarmjax.training import loop

REPEATS = 5


class TimedProgram(NamedTuple):
    """A compiled program `(state, argument) -> (state, rest)` that donates the state.

    Attributes:
      call: the program.
      compile_s: seconds of tracing and compiling.
      size: bytes of device memory that a call needs, including arguments and results, from XLA's
        analysis; Warp's own allocations are not included.
    """

    call: Callable[[Any, Any], tuple[Any, Any]]
    compile_s: float
    size: int


def compile_program(call: Callable[[Any, Any], Any], state: Any, argument: Any) -> TimedProgram:
    """Compiles a program ahead of time.

    Args:
      call: `(state, argument) -> (state, rest)`.
      state: the state, or its shapes.
      argument: the argument, or its shapes.

    Returns:
      The program.
    """
    began = time.perf_counter()
    lowered = jax.jit(call, donate_argnums=0).lower(state, argument)
    compiled = lowered.compile(loop.compiler_options())
    seconds = time.perf_counter() - began
    memory = compiled.memory_analysis()
    assert memory is not None  # available on both CPU and GPU
    size = memory.argument_size_in_bytes + memory.temp_size_in_bytes
    size += memory.output_size_in_bytes - memory.alias_size_in_bytes
    return TimedProgram(compiled, seconds, size)


def time_program(
    program: TimedProgram, state: Any, argument: Any, repeats: int = REPEATS
) -> tuple[list[float], Any]:
    """Times calls after a warm-up call; each call continues with the state of the previous call.

    Args:
      program: the program to call.
      state: the first state; it is donated.
      argument: argument of every call.
      repeats: number of timed calls.

    Returns:
      Seconds of each timed call, and the rest that the last call returned.
    """
    taken, rest = [], None
    for _ in range(1 + repeats):
        began = time.perf_counter()
        state, rest = program.call(state, argument)
        jax.block_until_ready((state, rest))
        taken.append(time.perf_counter() - began)
    return taken[1:], rest


def time_calls(call: Callable[[], Any], repeats: int = REPEATS) -> list[float]:
    """Times calls of a function that waits for its results, after a warm-up call.

    Args:
      call: the function to call.
      repeats: number of timed calls.

    Returns:
      Seconds of each timed call.
    """
    taken = []
    for _ in range(1 + repeats):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return taken[1:]


def spread(calls_s: list[float]) -> dict[str, Any]:
    """Returns the entries of a result line for the times of calls: all times and their median."""
    return {"calls_s": calls_s, "call_s": statistics.median(calls_s)}


def matmul_precision() -> str:
    """Returns the precision of JAX's matrix products; `default` may be TF32 on a GPU."""
    return jax.config.jax_default_matmul_precision or "default"
