"""How many arenas a device's memory holds, found before a run is given any of it.

A compiled program says what it takes: its arguments, what it works with, and what it returns but
for what lies where donated arguments lay. That is a straight line in the number of arenas
(docs/design-notes.md), so that two small programs, compiled and never run, tell what a large one
takes.
Warp's own temporary arrays are not in it: they lie outside of what JAX takes of a card.
"""

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import jax

from swarmjax.config import ConfigError
from swarmjax.run.settings import TrainConfig

ON_CPU = 128  # the default: more leave fewer updates of a budget, and gain little there
PROBE = 4096  # arenas of the larger small program: every accelerator holds them
MARGIN = 0.95  # of what fits by proportion: a program also has what does not grow with its arenas
# What XLA, CUDA and Warp through it, call memory that they did not get.
_EXHAUSTED = ("RESOURCE_EXHAUSTED", "OUT_OF_MEMORY", "Failed to allocate")


def limit() -> int | None:
    """Finds the memory of the first device: what JAX may take of a card, all that a computer has.

    Returns:
      Bytes; None where nobody tells.
    """
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return _host_memory()
    stats = device.memory_stats()
    return None if stats is None else stats.get("bytes_limit")


def _host_memory() -> int | None:
    """Memory of this computer, bytes; None where the operating system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows has none of it
        return None


def check_buffer(settings: TrainConfig, needed: int, available: int | None) -> None:
    """Refuses a buffer of levels that is larger than the memory by itself.

    Args:
      settings: of the run.
      needed: by the buffers of all seeds, each of which a device holds whole, bytes.
      available: bytes; None if it is not known, and then nothing is refused.

    Raises:
      ConfigError: with what is surely too much.
    """
    if available is not None and needed > available:
        levels = settings.curriculum.levels.buffer or 0
        each = f" for each of {settings.seeds} seeds" if settings.seeds > 1 else ""
        raise ConfigError(
            f"curriculum.levels.buffer is {levels}{each}, which needs {_gib(needed)} of memory, "
            f"and there is {_gib(available)}: give less than {int(levels * available / needed)}, "
            "or train on a device with more."
        )


def check_state(settings: TrainConfig, needed: int, available: int | None) -> None:
    """Refuses a run whose state alone, known before anything is compiled, is too large.

    Args:
      settings: of the run.
      needed: by the state, bytes.
      available: bytes; None if it is not known, and then nothing is refused.

    Raises:
      ConfigError: with what is surely too much; training takes many times its state.
    """
    if available is not None and needed > available:
        advice = _advice(settings, "less than", settings.arenas * available / needed)
        raise _too_many(settings, "its state alone needs", needed, available, advice)


def check(settings: TrainConfig, needed: int, available: int | None) -> None:
    """Refuses a run that does not fit.

    Args:
      settings: of the run.
      needed: by the compiled program, bytes.
      available: bytes; None if it is not known, and then nothing is refused.

    Raises:
      ConfigError: with about what fits.
    """
    if available is not None and needed > available:
        most = MARGIN * settings.arenas * available / needed
        advice = _advice(settings, "at most about", most)
        raise _too_many(settings, "training needs", needed, available, advice)


@contextlib.contextmanager
def refusal(settings: TrainConfig) -> Iterator[None]:
    """Puts it into one sentence where a device's memory turns out to be full.

    Raises:
      ConfigError: in place of JAX's error; every other error passes.
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
    """Chooses `arenas`: `algo.num_minibatches` times a power of two, as many as fit.

    Args:
      settings: of the run, with any number of arenas.
      measure: says what memory training with a config needs, bytes.
      available: of an accelerator, bytes, of which `run.memory_share` is filled; None on a CPU,
        and where nobody tells: the number is then at most ON_CPU, whatever the memory.

    Returns:
      The config with that number, and a sentence that says why it is that.
    """
    sizes = _sizes(settings)
    if available is None:
        arenas = max((each for each in sizes if each <= ON_CPU), default=sizes[0])
        why = f"arenas=auto: {arenas}, as wherever no GPU tells its memory."
        return replace(settings, arenas=arenas), why
    small = [each for each in sizes if each <= PROBE][-2:] or sizes[:1]
    fixed, each_one = line(settings, small, measure)
    room = settings.run.memory_share * available
    arenas = max((n for n in sizes if fixed + each_one * n <= room), default=sizes[0])
    more = "twice as many would take more than run.memory_share."
    if arenas == sizes[-1]:
        more = f"twice as many are refused: {_reason(settings, 2 * arenas)}"
    return replace(settings, arenas=arenas), (
        f"arenas=auto: {arenas:,}, which take {_gib(fixed + each_one * arenas)} of "
        f"{_gib(available)}, {each_one:,.0f} bytes each; {more}"
    )


def line(
    settings: TrainConfig, sizes: Sequence[int], measure: Callable[[TrainConfig], int]
) -> tuple[float, float]:
    """Finds what programs take as a straight line in their arenas.

    Args:
      settings: of the run.
      sizes: of one or two small programs, in arenas, rising; of one, all grows with its arenas.
      measure: as in `fill`.

    Returns:
      Bytes of no arena, and of each one.
    """
    # One update each: a call's metrics are no part of the line, and the same programs serve
    # whatever the budget.
    control_steps = settings.algo.rollout_length
    needed = [measure(replace(settings, arenas=n, budget=n * control_steps)) for n in sizes]
    if len(sizes) == 1:
        return 0.0, needed[0] / sizes[0]
    each = (needed[1] - needed[0]) / (sizes[1] - sizes[0])
    return needed[0] - each * sizes[0], each


def _sizes(settings: TrainConfig) -> list[int]:
    """Numbers that `arenas` may be by all the rest of the config, rising."""
    least = settings.algo.num_minibatches * settings.stream_count
    found = [replace(settings, arenas=least).arenas]
    with contextlib.suppress(ConfigError):
        while True:
            found.append(replace(settings, arenas=2 * found[-1]).arenas)
    return found


def _reason(settings: TrainConfig, arenas: int) -> str:
    """Why the rest of the config refuses a number of arenas."""
    try:
        replace(settings, arenas=arenas)
    except ConfigError as error:
        return str(error)
    return ""


def _advice(settings: TrainConfig, how: str, arenas: float) -> str:
    """Says what to give instead: arenas, rounded down to what can be trained, if that helps."""
    if settings.resume is not None:  # it keeps all that the memory depends on
        return "go on with it on a device that has more"
    fewest = settings.algo.num_minibatches
    if settings.arenas == fewest:
        return "give fewer seeds, sim.max_robots or algo.rollout_length"
    return f"give {how} {max(int(arenas) // fewest, 1) * fewest}"


def _too_many(
    settings: TrainConfig, what: str, needed: int, available: int, advice: str
) -> ConfigError:
    """The sentence that refuses a run."""
    return ConfigError(
        f"{_arenas(settings)}, but {what} {_gib(needed)} of memory and there is "
        f"{_gib(available)}: {advice}."
    )


def _arenas(settings: TrainConfig) -> str:
    """Names what was asked for."""
    each = f" for each of {settings.seeds} seeds" if settings.seeds > 1 else ""
    return f"arenas is {settings.arenas}{each}"


def _gib(amount: float) -> str:
    return f"{amount / 2**30:.3g} GiB"
