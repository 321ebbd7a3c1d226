"""Refuses a run that does not fit into a device's memory, before it allocates any of it.

A compiled program reports the memory of its arguments, temporaries and results. Results that reuse
donated arguments do not count. The total grows about linearly with the number of arenas
(docs/design-notes.md). Warp's temporary arrays are not included, because they lie outside JAX's
share of the GPU.
"""

import contextlib
import os
from collections.abc import Iterator

import jax

from swarmjax.config import ConfigError
from swarmjax.run.settings import TrainConfig

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
        try:
            return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (AttributeError, ValueError, OSError):  # Windows has no sysconf
            return None
    stats = device.memory_stats()
    return None if stats is None else stats.get("bytes_limit")


def check(
    settings: TrainConfig, needed: int, available: int | None, what: str = "training needs"
) -> None:
    """Refuses a run that does not fit into memory.

    Args:
      settings: the run's config.
      needed: memory for the compiled program, bytes.
      available: memory of the device, bytes; None if it is unknown, so that nothing is refused.
      what: what needs the memory, in the message.

    Raises:
      ConfigError: if it does not fit. The message names a number of arenas that should fit.
    """
    if available is None or needed <= available:
        return
    advice = _advice(settings, "at most about", MARGIN * settings.arenas * available / needed)
    raise ConfigError(
        f"{_arenas(settings)}, but {what} {_gib(needed)} of memory and there is "
        f"{_gib(available)}: {advice}."
    )


def check_state(settings: TrainConfig, needed: int, available: int | None) -> None:
    """Refuses a run whose state alone does not fit, as `check`, before anything is compiled."""
    check(settings, needed, available, "its state alone needs")


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


def _advice(settings: TrainConfig, how: str, arenas: float) -> str:
    """Suggests a number of arenas that can be trained, or another remedy if that does not help."""
    if settings.resume is not None:  # a resumed run cannot change what its memory depends on
        return "continue the run on a device with more memory"
    fewest = settings.algo.num_minibatches
    if settings.arenas == fewest:
        return "give fewer seeds, sim.max_robots or algo.rollout_length"
    return f"give {how} {max(int(arenas) // fewest, 1) * fewest}"


def _arenas(settings: TrainConfig) -> str:
    """States the number of arenas that was given."""
    each = f" for each of {settings.seeds} seeds" if settings.seeds > 1 else ""
    return f"arenas is {settings.arenas}{each}"


def _gib(amount: float) -> str:
    return f"{amount / 2**30:.3g} GiB"
