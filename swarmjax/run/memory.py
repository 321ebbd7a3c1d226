"""Refuses a run that does not fit into a device's memory, before the run allocates any.

A compiled program reports the memory of its arguments, temporaries and results. Results that reuse
the memory of donated arguments are left out. The total grows about linearly with the number of
arenas: on a CPU, a line through the totals of 128 and 256 arenas is less than 0.1 % off at 8,192
arenas. Warp's temporary arrays are not included, because they lie outside JAX's share of the GPU.
"""

import contextlib
import os
from collections.abc import Iterator

import jax

from swarmjax.config import ConfigError
from swarmjax.run.settings import TrainConfig

MARGIN = 0.95  # safety factor: part of the memory does not grow with the number of arenas
# Words with which XLA, CUDA, and Warp through CUDA report a failed allocation.
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


def check(settings: TrainConfig, needed: int) -> None:
    """Refuses a run that does not fit into memory.

    Args:
      settings: the run's config.
      needed: memory of a device that the run needs, bytes.

    Raises:
      ConfigError: if the run does not fit. The message names a number of arenas that should fit.
    """
    available = limit()
    if available is None or needed <= available:
        return
    fewest = settings.algo.num_minibatches
    fits = max(int(MARGIN * settings.arenas * available / needed) // fewest, 1) * fewest
    raise ConfigError(
        f"arenas is {settings.arenas} and seeds is {settings.seeds}, which needs {_gib(needed)} of "
        f"memory, but {_gib(available)} is there: give at most about {fits} arenas, or fewer seeds."
    )


@contextlib.contextmanager
def refusal(settings: TrainConfig) -> Iterator[None]:
    """Replaces JAX's out-of-memory error with one sentence.

    Raises:
      ConfigError: in place of JAX's error. Every other error passes.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if not any(words in str(error) for words in _EXHAUSTED):
            raise
        raise ConfigError(
            f"arenas is {settings.arenas}, but the memory of the device is full: give fewer arenas "
            "or seeds, or a device with more memory."
        ) from None


def _gib(amount: float) -> str:
    return f"{amount / 2**30:.3g} GiB"
