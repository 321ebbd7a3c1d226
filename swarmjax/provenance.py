"""Where a result comes from: versions, commit and device. No JAX needed but for the device."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

from swarmjax import words

_PACKAGES = (
    "swarmjax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "warp-lang",
    "flax",
    "optax",
    "numpy",
)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, where installed."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """Commit of the source tree, with `-dirty` if it was changed since; None without git.

    The environment variable `SWARMJAX_COMMIT` wins: it is for copies of the tree that left their
    history behind, or brought another one along.
    """
    given = os.environ.get("SWARMJAX_COMMIT")
    if given:
        return given
    tree = Path(__file__).resolve().parent
    try:
        head = _git(tree, "rev-parse", "--short=12", "HEAD")
        changed = _git(tree, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{head}-dirty" if changed else head


def device() -> str:
    """The accelerator's name, or the processor's with its number of cores."""
    import jax

    found = jax.devices()[0]
    if found.platform != "cpu":
        return f"{len(jax.devices())} x {found.device_kind}"
    return f"CPU {platform.machine()}, {words.count(cores(), 'core')}"


def cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux alone has it
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _git(tree: Path, *arguments: str) -> str:
    command = ["git", "-C", str(tree), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
