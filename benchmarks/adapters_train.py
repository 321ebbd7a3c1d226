"""Can other libraries train the swarm through their adapters?

`python -m benchmarks.adapters_train who=brax|sb3|torch [seed=0] [arenas=64] [budget=3000000]`
trains stage `s1` with the PPO of Brax, of Stable-Baselines3 or of examples/torch_ppo.py until 0.9
of the targets are reached, and prints a JSON line. The seconds in this line are training time
without compilation. Brax's evaluator judges the policy's mean action on one episode of each robot.
For the other two libraries the share of targets is measured over the last 200 robots whose episodes
ended in training, while the policy still explores. The command needs the extra with the library's
name.
"""

import contextlib
import importlib.util
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

import swarmjax
from benchmarks import key_value, peers
from swarmjax import provenance
from swarmjax.config import Section, about, to_dict

TARGET, RECENT = 0.9, 200


@dataclass(frozen=True, kw_only=True)
class AdapterTrainConfig(Section):
    """Settings: which library trains, and for how many robot steps at most."""

    who: Literal["brax", "sb3", "torch"] = field(default="brax", metadata=about("trains"))
    seed: int = field(default=0, metadata=about("random seed", 0, 2**31 - 1))
    arenas: int = field(default=64, metadata=about("arenas", 1, 2**16))
    budget: int = field(default=3_000_000, metadata=about("robot steps, at most", 1, 10**12))


class _Reached(Exception):  # noqa: N818  # not an error: training is over
    """Raised when the robots reach at least the share `TARGET` of their targets."""


def train_brax(given: AdapterTrainConfig) -> tuple[float, int, float]:
    """Trains with Brax's PPO.

    Returns:
      The share of targets reached, the number of robot steps, and the training time in seconds.
    """
    ppo = peers.find("brax.training.agents.ppo.train", "the extra brax")
    adapter = peers.find("swarmjax.adapters.brax_env", "the extra brax")
    env = adapter.SwarmBraxEnv(swarmjax.make_env("s1", arenas=given.arenas))
    curve: list[tuple[float, int, float]] = []

    def look(steps: int, metrics: dict[str, Any]) -> None:
        walltime = metrics.get("training/walltime", 0.0)
        curve.append((float(metrics["eval/episode_reached"]), steps, walltime))
        if curve[-1][0] >= TARGET:
            raise _Reached

    with adapter.mended_jax(), contextlib.suppress(_Reached):
        ppo.train(
            env,
            num_timesteps=given.budget,
            max_devices_per_host=1,
            wrap_env=False,
            num_envs=env.num_envs,
            num_eval_envs=env.num_envs,
            episode_length=env.robots.swarm.world.task.step_limit,
            num_evals=1 + given.budget // (20 * 32 * env.num_envs),
            deterministic_eval=True,
            batch_size=env.num_envs // 4,
            num_minibatches=4,
            unroll_length=32,
            num_updates_per_batch=6,
            discounting=0.99,
            learning_rate=1e-3,
            entropy_cost=0.0,
            clipping_epsilon=0.2,
            max_grad_norm=0.5,
            normalize_observations=True,
            progress_fn=look,
            seed=given.seed,
        )
    share, steps, _ = curve[-1]
    # The first two calls also compile. Each of them therefore counts with the median time of the
    # later calls, or with the shortest time of all calls if there are no later calls.
    calls = np.diff([seconds for *_, seconds in curve])
    calls[:2] = np.median(calls[2:]) if len(calls) > 2 else calls.min()
    return share, steps, float(calls.sum())


def train_sb3(given: AdapterTrainConfig) -> tuple[float, int, float]:
    """Trains with Stable-Baselines3's PPO; returns the same three numbers as `train_brax`."""
    library = peers.find("stable_baselines3", "the extra sb3")
    callbacks = peers.find("stable_baselines3.common.callbacks", "the extra sb3")
    adapter = peers.find("swarmjax.adapters.sb3", "the extra sb3")
    env = adapter.SwarmVecEnv(swarmjax.make_env("s1", arenas=given.arenas))
    env.reset()
    env.step(np.zeros((env.num_envs, 2), np.float32))
    recent: list[bool] = []
    peers.find("torch", "the extra sb3").set_num_threads(1)  # more threads are slower beside JAX's

    def look(values: dict[str, Any], _: Any) -> bool:
        ended = [info for info in values["infos"] if info]
        recent.extend(not info["TimeLimit.truncated"] for info in ended)
        return len(recent) < RECENT or float(np.mean(recent[-RECENT:])) < TARGET

    model = library.PPO(
        "MlpPolicy",
        env,
        n_steps=32,
        batch_size=32 * env.num_envs // 4,
        n_epochs=6,
        learning_rate=1e-3,
        policy_kwargs={"log_std_init": -0.5},
        seed=given.seed,
        device="cpu",
    )
    began = time.perf_counter()
    model.learn(given.budget, callback=callbacks.ConvertCallback(look))
    seconds = time.perf_counter() - began
    return float(np.mean(recent[-RECENT:])), model.num_timesteps, seconds


def train_torch(given: AdapterTrainConfig) -> tuple[float, int, float]:
    """Trains with examples/torch_ppo.py; returns the same three numbers as `train_brax`."""
    peers.find("torch", "the extra torch")
    path = Path(__file__).parents[1] / "examples" / "torch_ppo.py"
    spec = importlib.util.spec_from_file_location("torch_ppo", path)
    assert spec is not None
    assert spec.loader is not None
    example: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.ARENAS = given.arenas
    return example.train(given.budget // (2 * given.arenas * example.STEPS))


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given = key_value.parse(AdapterTrainConfig, arguments)[0]
    train = {"brax": train_brax, "sb3": train_sb3, "torch": train_torch}[given.who]
    packages = {"brax": ["brax"], "sb3": ["stable-baselines3", "torch"], "torch": ["torch"]}
    share, steps, seconds = train(given)
    line = {
        "benchmark": "adapters_train",
        "trainer": given.who,
        "stage": "s1",
        "targets_reached": share,
        "robot_steps": steps,
        "train_s": seconds,
        "settings": to_dict(given),
        "device": provenance.device(),
        "versions": peers.versions(*packages[given.who]),
        "commit": provenance.commit(),
    }
    peers.write([line])
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("adapters_train", main, AdapterTrainConfig))
