"""How fast is VMAS's navigation scenario, the PyTorch environment most similar to ours?

`python -m benchmarks.peer_vmas [arenas=4096,65536] [device=cuda] ...` needs the packages in
`torch-peers.txt` and prints a JSON line for each number of arenas. It times calls of `steps`
control steps with random actions drawn on the device. VMAS leaves resets to the caller, so the
timed calls have no resets. This is VMAS's best case. The line also has the time for resetting all
arenas.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from benchmarks import key_value, peers, timing
from benchmarks.peers import PeerConfig
from swarmjax import provenance
from swarmjax.config import about

SUBSTEPS = 2  # vmas.simulator.core.World's own default
COUNTED = {
    "step": "control step: two substeps of penalty contacts between discs in the plane, holonomic "
    "robots, 8 rays that see robots alone, no obstacles, reward",
    "resets": "none in the timed calls (VMAS leaves them to the caller): its best case",
    "precision": "float32, PyTorch without compilation",
}


@dataclass(frozen=True, kw_only=True)
class VmasConfig(PeerConfig):
    """Settings for measuring VMAS."""

    device: Literal["auto", "cuda", "cpu"] = field(
        default="auto", metadata=about("device of PyTorch; auto: cuda if there is one")
    )


def scenario(config: PeerConfig) -> dict[str, Any]:
    """Returns the settings of VMAS's navigation, with lengths in m, for an arena 1.2 m wide."""
    return {
        "scenario": "navigation",
        "n_agents": config.robots,
        "continuous_actions": True,
        "collisions": True,
        "enforce_bounds": True,
        "world_spawning_x": 0.6,
        "world_spawning_y": 0.6,
        "n_lidar_rays": 8,
        "lidar_range": 0.04,
        "agent_radius": 0.037,
        "shared_rew": False,
        "max_steps": config.step_limit,
    }


def results(config: VmasConfig) -> Iterator[dict[str, Any]]:
    """Measures the speed with each number of arenas, and yields a JSON line for each number."""
    torch, vmas = peers.find("torch", peers.TORCH), peers.find("vmas", peers.TORCH)
    device = peers.torch_device(torch, config.device)
    for arenas in config.arenas:
        world = vmas.make_env(num_envs=arenas, device=device, seed=config.seed, **scenario(config))
        with torch.no_grad():
            calls_s = timing.time_calls(partial(_steps, torch, world, config.steps), config.repeats)
            reset_s = timing.time_calls(partial(_reset, torch, world), config.repeats)
        yield {
            "benchmark": "peer_vmas.environment",
            "peer": "VMAS navigation",
            **peers.speed(config, arenas, SUBSTEPS, calls_s),
            "reset_s": reset_s,
            "compile_s": None,
            **COUNTED,
            "settings": scenario(config),
            "device": peers.torch_device_name(torch, device),
            "versions": peers.versions("torch", "vmas"),
            "commit": provenance.commit(),
        }


def _steps(torch: Any, world: Any, steps: int) -> None:
    """Steps all arenas with random actions, and waits for the device."""
    actions = torch.rand(steps, world.n_agents, world.num_envs, 2, device=world.device) * 2 - 1
    for step in actions:
        world.step(list(step))
    _wait(torch)


def _reset(torch: Any, world: Any) -> None:
    world.reset()
    _wait(torch)


def _wait(torch: Any) -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    peers.write(results(key_value.load(VmasConfig, arguments)))
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("peer_vmas", main, VmasConfig))
