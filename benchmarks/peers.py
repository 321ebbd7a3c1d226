"""What benchmarks of other projects share: what they are asked, and what their lines say.

A peer is an optional extra, or stands in `torch-peers.txt`. Where one is missing, its benchmark
prints one line with the reason as `skipped`, and ends well.
"""

import importlib
import importlib.metadata
import json
import platform
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks import timing
from swarmjax import command, provenance
from swarmjax.config import Section, about

TORCH = "benchmarks/torch-peers.txt"


class MissingPeerError(Exception):
    """A peer that is not installed, or does not import, in one sentence."""


@dataclass(frozen=True, kw_only=True)
class PeerConfig(Section):
    """How a peer's environment is measured: as ours, where it can be."""

    arenas: tuple[int, ...] = field(
        default=(65536,), metadata=about("numbers of arenas, one after the other", 1, 2**20)
    )
    robots: int = field(default=5, metadata=about("robots of an arena", 1, 100))
    steps: int = field(default=64, metadata=about("control steps of a call", 1, 10**6))
    repeats: int = field(default=5, metadata=about("calls that are timed", 1, 1000))
    step_limit: int = field(default=500, metadata=about("control steps of an episode", 1, 10**6))
    seed: int = field(default=0, metadata=about("random seed", 0, 2**31 - 1))


def find(module: str, source: str) -> Any:
    """Imports a module of a peer.

    Args:
      module: its name.
      source: what brings it, an extra of pyproject.toml or a file of requirements.

    Returns:
      The module.

    Raises:
      MissingPeerError: if it cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except Exception as error:  # whatever a half-installed library raises as it is imported
        reason = str(error).strip().partition("\n")[0].rstrip(".")
        raise MissingPeerError(
            f"{module} cannot be imported ({reason}): install {source}."
        ) from error


def run(name: str, main: Callable[[Sequence[str]], int], cls: type[Section]) -> int:
    """Runs a peer's benchmark as `command.run` does; without the peer it says so in a line."""

    def run_or_skip(words: Sequence[str]) -> int:
        try:
            return main(words)
        except MissingPeerError as error:
            write([{"benchmark": name, "skipped": str(error)}])
            return 0

    return command.run(name, run_or_skip, cls)


def write(lines: Iterator[dict[str, Any]] | Sequence[dict[str, Any]]) -> None:
    """Prints JSON lines, each as soon as it is there."""
    for line in lines:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def versions(*packages: str) -> dict[str, str]:
    """Versions of these packages, besides those of `provenance.versions`."""
    return provenance.versions() | {name: importlib.metadata.version(name) for name in packages}


def speed(
    config: PeerConfig, arenas: int, substeps: int | None, calls_s: list[float]
) -> dict[str, Any]:
    """The fields of a line that say how fast an environment was.

    Args:
      config: what was measured.
      arenas: how many.
      substeps: physics steps of a control step; None where there is no such thing.
      calls_s: seconds of each call.

    Returns:
      Fields under the names of docs/interface.md.
    """
    rate = config.steps * arenas / statistics.median(calls_s)
    return {
        "arenas": arenas,
        "robots": config.robots,
        "substeps": substeps,
        "control_steps": config.steps,
        "arena_steps_per_s": rate,
        "robot_steps_per_s": rate * config.robots,
        "physics_steps_per_s": None if substeps is None else rate * substeps,
        "transitions_per_s": None,
        **timing.spread(calls_s),
    }


def torch_device(torch: Any, wanted: str) -> str:
    """The device that PyTorch is to use, where `auto` leaves it open."""
    if wanted != "auto":
        return wanted
    return "cuda" if torch.cuda.is_available() else "cpu"


def torch_device_name(torch: Any, device: str) -> str:
    """Names a device of PyTorch's as `provenance.device` does one of JAX's."""
    if device == "cuda":
        return f"{torch.cuda.device_count()} x {torch.cuda.get_device_name(0)}"
    return f"CPU {platform.machine()}, {provenance.cores()} cores"
