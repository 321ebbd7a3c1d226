"""Describes where a result comes from: versions, commit and device. Only `device` needs JAX."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

from swarmjax import words

_PACKAGES = (
    *("swarmjax", "jax", "jaxlib", "mujoco", "mujoco-mjx"),
    *("warp-lang", "flax", "optax", "numpy"),
)


def versions() -> dict[str, str]:
    """Returns the versions of Python and of all installed packages that results depend on."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """Returns the commit of the source tree, with `-dirty` if files have changed; None without git.

    The environment variable `SWARMJAX_COMMIT` takes precedence. Set it for a copy of the tree that
    has no Git history of its own or lies in another repository.
    """
    given = os.environ.get("SWARMJAX_COMMIT")
    if given:
        return given
    tree = str(Path(__file__).resolve().parent)
    # With all tags excluded, git describes the commit by its hash.
    command = ["git", "-C", tree, "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def device() -> str:
    """Returns the number and name of the accelerators, or the processor and its number of cores."""
    import jax

    found = jax.devices()[0]
    if found.platform != "cpu":
        return f"{len(jax.devices())} x {found.device_kind}"
    return f"CPU {platform.machine()}, {words.count(cores(), 'core')}"


def cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # only on Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
