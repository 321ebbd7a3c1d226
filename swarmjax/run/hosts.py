"""Lets several processes train one run, on one or more hosts.

The first process displays the run and writes the run directory. The other processes write into a
temporary folder. All processes must make the same calls of the compiled program. So they decide
together about anything that depends on a clock or a signal.
"""

import contextlib
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np
from jax.experimental import multihost_utils

from swarmjax import provenance
from swarmjax.config import ConfigError, files, show, to_dict
from swarmjax.run.errors import LostPeerError
from swarmjax.run.settings import TrainConfig

CHECKPOINTS = "checkpoints"  # folder in a run directory
# A process that does not join is reported within a minute, and a lost one within half a minute.
_JOIN_S, _HEARTBEAT_S = 45, 20
# Keys that may differ between processes, so the comparison replaces their values.
_OWN = {"run.id": None}


def join(settings: TrainConfig) -> None:
    """Joins the other processes of a run, if `run.distributed` is true.

    `jax.distributed.initialize` documents how JAX finds the other processes. JAX reads
    `JAX_COORDINATOR_ADDRESS` itself, but not `JAX_NUM_PROCESSES` and `JAX_PROCESS_ID`, which are
    needed without a cluster's scheduler.

    Args:
      settings: the run's config.

    Raises:
      ConfigError: if the other processes do not join, or have other settings or versions.
    """
    if not settings.run.distributed:
        return
    names = {"num_processes": "JAX_NUM_PROCESSES", "process_id": "JAX_PROCESS_ID"}
    try:
        given: dict[str, Any] = {
            key: int(os.environ[name]) for key, name in names.items() if name in os.environ
        }
        jax.distributed.initialize(
            **given,
            initialization_timeout=_JOIN_S,
            heartbeat_timeout_seconds=_HEARTBEAT_S,
            shutdown_timeout_seconds=_HEARTBEAT_S,
        )
    except Exception as error:  # JAX's transport raises errors of many types
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise ConfigError(
            f"run.distributed is true, but the processes of the run did not connect within "
            f"{_JOIN_S} s ({reason}): start all of them, and check JAX_COORDINATOR_ADDRESS, "
            "JAX_NUM_PROCESSES and JAX_PROCESS_ID."
        ) from None
    _check_alike(settings)
    _check_devices(settings)


def count() -> int:
    """Returns the number of processes of this run."""
    return jax.process_count()


def is_first() -> bool:
    """Returns whether this process displays the run and writes its directory."""
    return jax.process_index() == 0


def share(value: int) -> np.ndarray:
    """Shares one number per process among all processes.

    Args:
      value: the integer that this process contributes, 32 bits.

    Returns:
      [P] the integers of all P processes, in the order of the processes.
    """
    if count() == 1:
        return np.array([value])
    return np.asarray(multihost_utils.process_allgather(np.int32(value))).reshape(-1)


def share_text(text: str) -> str:
    """Returns the text of the first process, on all processes."""
    if count() == 1:
        return text
    mine = text.encode()
    padded = np.zeros(int(share(len(mine)).max()), np.uint8)
    padded[: len(mine)] = np.frombuffer(mine, np.uint8)
    found = np.asarray(multihost_utils.broadcast_one_to_all(padded))
    return bytes(found.astype(np.uint8)).rstrip(b"\0").decode()


def gather(tree: Any) -> Any:
    """Gathers, on every process, arrays that are spread over hosts."""
    if count() == 1:
        return tree

    def whole(x: jax.Array) -> Any:
        if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key):
            x = jax.random.key_data(x)
        if x.is_fully_addressable or x.is_fully_replicated:
            return np.asarray(x)
        return multihost_utils.process_allgather(x, tiled=True)

    return jax.tree.map(whole, tree)


@contextlib.contextmanager
def lost_peers() -> Iterator[None]:
    """Replaces JAX's error about a lost process with one sentence.

    Raises:
      LostPeerError: if another process of the run is gone.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if count() == 1:
            raise
        reason = (str(error).splitlines() or [""])[0][:120]
        raise LostPeerError(f"another process of the run has ended ({reason}).") from None


@contextlib.contextmanager
def own_directory(run: Path) -> Iterator[Path]:
    """Gives the first process the run directory, and the others a temporary directory.

    The temporary directory links to the checkpoints of the first process. The other processes also
    print nothing.

    Args:
      run: the run directory of the first process.
    """
    shared = Path(share_text(str(run.resolve())))
    if is_first():
        yield run
        return
    with (
        tempfile.TemporaryDirectory() as folder,
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
    ):
        own = Path(folder) / "run"
        own.mkdir()
        (own / CHECKPOINTS).symlink_to(shared / CHECKPOINTS)
        yield own


def leave(code: int) -> NoReturn:
    """Ends this process at once. At a normal exit, JAX would wait for the lost processes.

    Args:
      code: the exit code.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _check_alike(settings: TrainConfig) -> None:
    """Refuses processes that would run different programs."""
    versions = {f"version of {name}": value for name, value in provenance.versions().items()}
    own = json.loads(json.dumps(files.flatten(to_dict(settings)) | versions | _OWN))
    theirs = json.loads(share_text(json.dumps(own)))
    if not share(own != theirs).any():
        return
    differing = [
        f"{key} is {show(own[key])} here and {show(theirs.get(key))} in process 0"
        for key in own
        if own[key] != theirs.get(key)
    ]
    other = "another process has other settings or versions"  # here, in process 0, nothing differs
    raise ConfigError(f"{differing[0] if differing else other}: give all processes the same.")


def _check_devices(settings: TrainConfig) -> None:
    found = jax.device_count()
    if settings.devices != found:
        raise ConfigError(
            f"devices is {settings.devices}, but the {count()} processes of the run have {found} "
            f"devices: give devices={found}."
        )
