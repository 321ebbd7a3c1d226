"""Estimates how many arenas fit into a device's memory, before the run allocates any of it.

A compiled program reports the memory of its arguments, temporaries and results. Results that reuse
donated arguments do not count. The total grows linearly with the number of arenas
(docs/design-notes.md). So two small programs, compiled but never run, predict the memory of a large
one. Warp's temporary arrays are not included, because they lie outside JAX's share of the GPU.
"""

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import jax

from swarmjax.config import ConfigError
from swarmjax.run.settings import TrainConfig

ON_CPU = 128  # the default. More arenas leave fewer updates and gain little speed on a CPU.
PROBE = 4096  # largest number of arenas in the two small programs. Every accelerator holds them.
SHARE = 0.8  # of the memory of an accelerator, which `fill` fills
MARGIN = 0.95  # factor on the proportional estimate: part of the memory does not grow with arenas
# How XLA, CUDA, and Warp through CUDA, report a failed allocation.
_EXHAUSTED = ("RESOURCE_EXHAUSTED", "OUT_OF_MEMORY", "Failed to allocate")


def limit() -> int | None:
    """Finds the memory of the first device: JAX's share of a GPU, or the host's whole memory.

    Returns:
      Bytes; None if the device or the system does not report it.
    """
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return _host_memory()
    stats = device.memory_stats()
    return None if stats is None else stats.get("bytes_limit")


def _host_memory() -> int | None:
    """Returns the memory of this computer, bytes; None if the system does not report it."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return None


def check_state(settings: TrainConfig, needed: int, available: int | None) -> None:
    """Refuses a run whose state alone is too large, before anything is compiled.

    Args:
      settings: the run's config.
      needed: memory for the state, bytes.
      available: memory of the device, bytes; None if it is unknown, so that nothing is refused.

    Raises:
      ConfigError: if the state cannot fit. The message names a number of arenas that is certainly
        too large, because training takes many times the memory of its state.
    """
    if available is not None and needed > available:
        advice = _advice(settings, "less than", settings.arenas * available / needed)
        raise _too_many(settings, "its state alone needs", needed, available, advice)


def check(settings: TrainConfig, needed: int, available: int | None) -> None:
    """Refuses a run that does not fit into memory.

    Args:
      settings: the run's config.
      needed: memory for the compiled program, bytes.
      available: memory of the device, bytes; None if it is unknown, so that nothing is refused.

    Raises:
      ConfigError: if the program does not fit. The message names a number of arenas that should
        fit.
    """
    if available is not None and needed > available:
        most = MARGIN * settings.arenas * available / needed
        advice = _advice(settings, "at most about", most)
        raise _too_many(settings, "training needs", needed, available, advice)


@contextlib.contextmanager
def refusal(settings: TrainConfig) -> Iterator[None]:
    """Replaces JAX's out-of-memory error by one sentence.

    Raises:
      ConfigError: in place of JAX's error. Every other error passes.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if not any(words in str(error) for words in _EXHAUSTED):
            raise
        advice = _advice(settings, "about", settings.arenas / 2)
        raise ConfigError(
            f"{_arenas(settings)}, but the memory of the device is full: {advice}."
        ) from None


def fill(
    settings: TrainConfig, measure: Callable[[TrainConfig], int], available: int | None
) -> tuple[TrainConfig, str]:
    """Chooses the largest `arenas` that fits: `algo.num_minibatches` times a power of two.

    Args:
      settings: the run's config, with any number of arenas.
      measure: returns the memory that training with a config needs, bytes.
      available: memory of the accelerator, bytes. The share `SHARE` of this memory is filled. None
        on a CPU, or if the memory is unknown; at most ON_CPU arenas are chosen then.

    Returns:
      The config with that number, and a sentence that gives the reason.
    """
    sizes = _sizes(settings)
    if available is None:
        arenas = max((each for each in sizes if each <= ON_CPU), default=sizes[0])
        why = f"arenas=auto: {arenas}, the default where no GPU reports its memory."
        return replace(settings, arenas=arenas), why
    small = [each for each in sizes if each <= PROBE][-2:] or sizes[:1]
    fixed, each_one = line(settings, small, measure)
    room = SHARE * available
    arenas = max((n for n in sizes if fixed + each_one * n <= room), default=sizes[0])
    more = f"twice as many would take more than {100 * SHARE:.0f} %."
    if arenas == sizes[-1]:
        more = f"twice as many are refused: {_reason(settings, 2 * arenas)}"
    return replace(settings, arenas=arenas), (
        f"arenas=auto: {arenas:,}, which take {_gib(fixed + each_one * arenas)} of "
        f"{_gib(available)}, {each_one:,.0f} bytes each; {more}"
    )


def line(
    settings: TrainConfig, sizes: Sequence[int], measure: Callable[[TrainConfig], int]
) -> tuple[float, float]:
    """Fits a straight line to the memory of programs by their number of arenas.

    Args:
      settings: the run's config.
      sizes: numbers of arenas of one or two small programs, rising. With one program, the line
        passes through 0.
      measure: as in `fill`.

    Returns:
      Fixed bytes, and bytes per arena.
    """
    # Each program does one update. So the metrics of longer calls are not counted, and the compiled
    # programs do not depend on the budget.
    control_steps = settings.algo.rollout_length
    needed = [measure(replace(settings, arenas=n, budget=n * control_steps)) for n in sizes]
    if len(sizes) == 1:
        return 0.0, needed[0] / sizes[0]
    each = (needed[1] - needed[0]) / (sizes[1] - sizes[0])
    return needed[0] - each * sizes[0], each


def _sizes(settings: TrainConfig) -> list[int]:
    """Returns the numbers of arenas that the rest of the config allows, rising."""
    least = settings.algo.num_minibatches * settings.stream_count
    found = [replace(settings, arenas=least).arenas]
    with contextlib.suppress(ConfigError):
        while True:
            found.append(replace(settings, arenas=2 * found[-1]).arenas)
    return found


def _reason(settings: TrainConfig, arenas: int) -> str:
    """Explains why the rest of the config refuses a number of arenas."""
    try:
        replace(settings, arenas=arenas)
    except ConfigError as error:
        return str(error)
    return ""


def _advice(settings: TrainConfig, how: str, arenas: float) -> str:
    """Suggests a number of arenas that can be trained, or another remedy if that does not help."""
    if settings.resume is not None:  # a resumed run cannot change what its memory depends on
        return "continue the run on a device with more memory"
    fewest = settings.algo.num_minibatches
    if settings.arenas == fewest:
        return "give fewer seeds, sim.max_robots or algo.rollout_length"
    return f"give {how} {max(int(arenas) // fewest, 1) * fewest}"


def _too_many(
    settings: TrainConfig, what: str, needed: int, available: int, advice: str
) -> ConfigError:
    """Makes the error that refuses a run."""
    return ConfigError(
        f"{_arenas(settings)}, but {what} {_gib(needed)} of memory and there is "
        f"{_gib(available)}: {advice}."
    )


def _arenas(settings: TrainConfig) -> str:
    """States the number of arenas that was given."""
    each = f" for each of {settings.seeds} seeds" if settings.seeds > 1 else ""
    return f"arenas is {settings.arenas}{each}"


def _gib(amount: float) -> str:
    return f"{amount / 2**30:.3g} GiB"
