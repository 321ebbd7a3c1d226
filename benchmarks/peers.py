"""Measures other projects, with settings equal to ours where possible.

`python -m benchmarks.peers who=NAME [key=value ...]` prints the JSON lines of a peer. `vmas`,
`camar` and `jaxnav` are environments (`benchmarks.peer_environments`). `benchmarl` and
`jaxmarl_ippo` are trainers with environments of their own, and `sb3` trains on ours
(`benchmarks.peer_trainers`). `paper_way` trains our robots in MuJoCo C
(`benchmarks.peer_paper_way`). The peer's functions say which keys it has and how it is measured.

A peer is installed as an optional extra of this package or from `torch-peers.txt`. If a peer is
missing, the command prints one line with the reason as `skipped`, and exits with code 0.
"""

import importlib
import importlib.metadata
import platform
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks import lines, timing
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about, show

TORCH = "benchmarks/torch-peers.txt"
# The module of each peer's function, which takes words and yields JSON lines.
PEERS = {
    "vmas": "peer_environments",
    "camar": "peer_environments",
    "jaxnav": "peer_environments",
    "benchmarl": "peer_trainers",
    "jaxmarl_ippo": "peer_trainers",
    "sb3": "peer_trainers",
    "paper_way": "peer_paper_way",
}


class MissingPeerError(Exception):
    """Raised when a peer is not installed or cannot be imported; the reason is one sentence."""


@dataclass(frozen=True, kw_only=True)
class WhoConfig(Section):
    """Settings: which peer is measured."""

    who: str = field(metadata=about(f"peer: {', '.join(PEERS)}"))

    def _check(self) -> None:
        if self.who not in PEERS:
            raise ConfigError(f"who is {show(self.who)}: give one of {', '.join(PEERS)}.")


@dataclass(frozen=True, kw_only=True)
class PeerConfig(Section):
    """Settings for measuring a peer's environment, equal to ours where possible."""

    arenas: tuple[int, ...] = field(
        default=(65536,), metadata=about("numbers of arenas, one after the other", 1, 2**20)
    )
    robots: int = field(default=5, metadata=about("robots per arena", 1, 100))
    steps: int = field(default=64, metadata=about("control steps per call", 1, 10**6))
    repeats: int = field(default=5, metadata=about("number of timed calls", 1, 1000))
    step_limit: int = field(default=500, metadata=about("control steps per episode", 1, 10**6))
    seed: int = field(default=0, metadata=about("random seed", 0, 2**31 - 1))


def find(module: str, source: str) -> Any:
    """Imports a module of a peer.

    Args:
      module: name of the module.
      source: the extra of pyproject.toml, or the requirements file, that installs the peer.

    Returns:
      The module.

    Raises:
      MissingPeerError: if the module cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except Exception as error:  # a partly installed library may raise any exception
        reason = str(error).strip().partition("\n")[0].rstrip(".")
        raise MissingPeerError(
            f"{module} cannot be imported ({reason}): install {source}."
        ) from error


def run(name: str, main: Callable[[Sequence[str]], int], cls: type[Section]) -> int:
    """Runs a benchmark with `command.run`; prints a `skipped` line if the peer is missing."""

    def run_or_skip(words: Sequence[str]) -> int:
        try:
            return main(words)
        except MissingPeerError as error:
            lines.write([{"benchmark": name, "skipped": str(error)}])
            return 0

    return command.run(name, run_or_skip, cls)


def versions(*packages: str) -> dict[str, str]:
    """Returns `provenance.versions` plus the versions of the given packages."""
    return provenance.versions() | {name: importlib.metadata.version(name) for name in packages}


def speed(
    config: PeerConfig, arenas: int, substeps: int | None, calls_s: list[float]
) -> dict[str, Any]:
    """Returns the entries of a result line that describe an environment's speed.

    Args:
      config: settings of the measurement.
      arenas: number of arenas.
      substeps: physics steps per control step; None if the environment has none.
      calls_s: seconds of each timed call.

    Returns:
      Entries with the names in docs/interface.md.
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


def training(
    robots: int, arenas: int, arena_steps_per_s: float, calls_s: list[float]
) -> dict[str, Any]:
    """Returns the entries of a result line that describe a trainer's speed.

    Args:
      robots: robots per arena, each of which learns from every step.
      arenas: number of arenas.
      arena_steps_per_s: control steps of all arenas together, per second.
      calls_s: seconds of each timed call.

    Returns:
      Entries with the names in docs/interface.md.
    """
    return {
        "arenas": arenas,
        "robots": robots,
        "arena_steps_per_s": arena_steps_per_s,
        "robot_steps_per_s": arena_steps_per_s * robots,
        "transitions_per_s": arena_steps_per_s * robots,
        "compile_s": None,
        **timing.spread(calls_s),
    }


def timed(
    call: Callable[[Any, Any], Any], state: Any, argument: Any, repeats: int
) -> tuple[list[float], dict[str, Any]]:
    """Compiles and times a program in JAX, as `timing.compile_program` takes it.

    Returns:
      Seconds of each timed call, and the entries of a result line about the compiled program.
    """
    program = timing.compile_program(call, state, argument)
    calls_s, _ = timing.time_program(program, state, argument, repeats)
    return calls_s, {"compile_s": program.compile_s, "program_bytes": program.size}


def with_jax(*packages: str) -> dict[str, Any]:
    """Returns the entries that give device, versions and commit of a peer that uses JAX."""
    return {
        "matmul_precision": timing.matmul_precision(),
        **lines.made_with(),
        "versions": versions(*packages),
    }


def with_torch(torch: Any, device: str, *packages: str) -> dict[str, Any]:
    """Returns the entries that give device, versions and commit of a peer that uses PyTorch."""
    return {
        "device": torch_device_name(torch, device),
        "versions": versions("torch", *packages),
        "commit": provenance.commit(),
    }


def torch_device(torch: Any, wanted: str) -> str:
    """Returns the device for PyTorch; `auto` means CUDA if it is available, else the CPU."""
    if wanted != "auto":
        return wanted
    return "cuda" if torch.cuda.is_available() else "cpu"


def torch_device_name(torch: Any, device: str) -> str:
    """Names a PyTorch device as `provenance.device` names a JAX device."""
    if device == "cuda":
        return f"{torch.cuda.device_count()} x {torch.cuda.get_device_name(0)}"
    return f"CPU {platform.machine()}, {provenance.cores()} cores"


def main(words: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    chosen, rest = lines.parse(WhoConfig, words)
    module = importlib.import_module(f"benchmarks.{PEERS[chosen.who]}")
    lines.write(getattr(module, chosen.who)(rest))
    return 0


if __name__ == "__main__":
    # The peers' modules raise the `MissingPeerError` of `benchmarks.peers`, not of `__main__`.
    from benchmarks import peers

    sys.exit(peers.run("peers", peers.main, WhoConfig))
