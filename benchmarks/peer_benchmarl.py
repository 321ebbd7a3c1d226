"""How fast does BenchMARL, which uses PyTorch, train VMAS's navigation scenario with IPPO?

`python -m benchmarks.peer_benchmarl [arenas=4096] [device=cuda] ...` needs the packages in
`torch-peers.txt` and prints a JSON line for each number of arenas. The line has the seconds of all
iterations except the first two. An iteration collects a rollout and learns from it, without logging
or evaluation. The task, the networks, the rollout length, and the numbers of epochs and minibatches
are those of swarmjax. All other settings are BenchMARL's defaults.
"""

import contextlib
import itertools
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from benchmarks import key_value, peer_vmas, peers, timing
from benchmarks.peers import PeerConfig
from swarmjax import provenance
from swarmjax.config import about, to_dict

_WARM = 2  # warm-up iterations


@dataclass(frozen=True, kw_only=True)
class BenchmarlConfig(PeerConfig):
    """Settings for measuring BenchMARL; `steps` is not used."""

    device: Literal["auto", "cuda", "cpu"] = field(
        default="auto", metadata=about("device of PyTorch; auto: cuda if there is one")
    )
    rollout: int = field(default=32, metadata=about("control steps per iteration", 1, 10**4))
    epochs: int = field(default=4, metadata=about("passes over a rollout", 1, 100))
    minibatches: int = field(default=8, metadata=about("gradient steps per pass", 1, 1000))


def experiment(
    config: BenchmarlConfig, arenas: int, device: str, folder: str, callback: Any
) -> Any:
    """Makes BenchMARL's experiment.

    Args:
      config: the settings.
      arenas: number of arenas.
      device: device of PyTorch.
      folder: folder for the files that BenchMARL always writes.
      callback: a BenchMARL callback.

    Returns:
      The experiment, ready to run.
    """
    algorithms = peers.find("benchmarl.algorithms", peers.TORCH)
    environments = peers.find("benchmarl.environments", peers.TORCH)
    experiments = peers.find("benchmarl.experiment", peers.TORCH)
    models = peers.find("benchmarl.models.mlp", peers.TORCH)
    torch = peers.find("torch", peers.TORCH)
    task = environments.VmasTask.NAVIGATION.get_from_yaml()
    task.config |= {
        key: value
        for key, value in peer_vmas.scenario(config).items()
        if key not in ("scenario", "continuous_actions")
    }
    model = models.MlpConfig(
        num_cells=[64, 64], activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear
    )
    chosen = experiments.ExperimentConfig.get_from_yaml()
    for name, value in changes(config, arenas, device, folder).items():
        setattr(chosen, name, value)
    return experiments.Experiment(
        task=task,
        algorithm_config=algorithms.IppoConfig.get_from_yaml(),
        model_config=model,
        critic_model_config=model,
        seed=config.seed,
        config=chosen,
        callbacks=[callback],
    )


def changes(config: BenchmarlConfig, arenas: int, device: str, folder: str) -> dict[str, Any]:
    """Returns our changes to BenchMARL's defaults: batch, device, no files and no evaluation."""
    frames = arenas * config.rollout
    return {
        "sampling_device": device,
        "train_device": device,
        "buffer_device": device,
        "on_policy_n_envs_per_worker": arenas,
        "on_policy_collected_frames_per_batch": frames,
        "on_policy_n_minibatch_iters": config.epochs,
        "on_policy_minibatch_size": frames // config.minibatches,
        "max_n_frames": None,
        "max_n_iters": _WARM + config.repeats,
        "evaluation": False,
        "render": False,
        "loggers": [],
        "create_json": False,
        "checkpoint_interval": 0,
        "checkpoint_at_end": False,
        "save_folder": folder,
    }


def clock(torch: Any, ends: list[float]) -> Any:
    """Makes a callback that appends the time at the end of each iteration's learning to `ends`."""

    def note(self: Any, training_td: Any, group: str) -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        ends.append(time.perf_counter())

    base = peers.find("benchmarl.experiment.callback", peers.TORCH).Callback
    # BenchMARL pickles its callbacks, and cannot find a class defined in a function.
    members = {"on_train_end": note, "__reduce__": lambda self: (object, ())}
    return type("Clock", (base,), members)()


def results(config: BenchmarlConfig) -> Iterator[dict[str, Any]]:
    """Trains with each number of arenas, and yields a JSON line for each number."""
    torch = peers.find("torch", peers.TORCH)
    device = peers.torch_device(torch, config.device)
    for arenas in config.arenas:
        ends: list[float] = []
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
            experiment(config, arenas, device, folder, clock(torch, ends)).run()
        calls_s = [after - before for before, after in itertools.pairwise(ends[_WARM - 1 :])]
        rate = config.rollout * arenas / timing.spread(calls_s)["call_s"]
        yield {
            "benchmark": "peer_benchmarl",
            "trainer": "BenchMARL IPPO, VMAS navigation",
            "arenas": arenas,
            "robots": config.robots,
            "arena_steps_per_s": rate,
            "robot_steps_per_s": rate * config.robots,
            "transitions_per_s": rate * config.robots,
            "compile_s": None,
            **timing.spread(calls_s),
            "settings": to_dict(config) | {"task": peer_vmas.scenario(config)},
            "device": peers.torch_device_name(torch, device),
            "versions": peers.versions("torch", "vmas", "benchmarl", "torchrl", "tensordict"),
            "commit": provenance.commit(),
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    peers.write(results(key_value.load(BenchmarlConfig, arguments)))
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("peer_benchmarl", main, BenchmarlConfig))
