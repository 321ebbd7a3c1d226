"""How fast does Stable-Baselines3's PPO train on a vectorised environment in MuJoCo C?

`python -m benchmarks.cpu_sb3 [arenas=16] [workers=2] [seconds=30] [key=value ...]` takes the keys
of `swarmjax.evaluate` and needs the packages in `torch-peers.txt`. Every robot is one environment
of Stable-Baselines3. All robots share one policy, and `workers` processes simulate the arenas.
Networks, batch per robot, epochs, minibatches, discount and clip are those of `algo=ppo`.
Observations are not normalised. Stable-Baselines3 cannot mask samples, so an arrived robot stays in
the batch with reward 0 until its arena's episode ends. After one warm-up iteration, the command
times iterations of rollout and update until `seconds` have passed.
"""

import itertools
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from benchmarks import key_value, mujoco_arena, peers, timing
from benchmarks.mujoco_arena import MujocoArena
from swarmjax import provenance
from swarmjax.config import ConfigError, Section, about, to_dict
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.ppo import optimizer
from swarmjax.run.load_settings import load_train

_LEVELS = 1_000_000  # level numbers reserved for each arena


@dataclass(frozen=True, kw_only=True)
class Sb3Config(Section):
    """Settings: how many arenas and processes, and how long to measure."""

    arenas: int = field(default=16, metadata=about("arenas", 1, 4096))
    workers: int = field(default=2, metadata=about("processes that simulate", 1, 256))
    seconds: float = field(default=30.0, metadata=about("minimum time of iterations", above=0.0))

    def _check(self) -> None:
        if self.arenas % self.workers:
            raise ConfigError(
                f"arenas is {self.arenas}, but workers is {self.workers}: give a multiple."
            )


def serve(pipe: Connection, judged: EvaluateConfig, numbers: Sequence[int]) -> None:
    """Simulates some arenas in a worker process, until it receives None.

    Args:
      pipe: connection to the main process. The worker first sends the initial observations
        [A R, O]. For each message of actions [A R, 2] the worker then sends observations [A R, O],
        reward, done and truncated [A R], and the observations before any reset [A R, O].
      judged: settings of the arenas.
      numbers: [A] numbers of the arenas.
    """
    arenas = [MujocoArena(judged, number * _LEVELS) for number in numbers]
    seen = [arena.reset() for arena in arenas]
    waits = [np.zeros(len(each), bool) for each in seen]
    pipe.send(np.concatenate(seen))
    while (action := pipe.recv()) is not None:
        split = np.split(action, len(arenas))
        found = [_step(*each) for each in zip(arenas, split, waits, strict=True)]
        waits = [waiting for *_, waiting in found]
        pipe.send([np.concatenate([each[i] for each in found]) for i in range(5)])


def _step(arena: MujocoArena, action: np.ndarray, waits: np.ndarray) -> tuple[np.ndarray, ...]:
    """Steps an arena, and resets it if its episode is over.

    Returns:
      [R, ...]: observation after any reset, reward, done, truncated, observation before the reset,
      and which robots wait.
    """
    moved = arena.step(action)
    arrives = moved.arrived & ~waits
    truncated = moved.over & ~moved.arrived
    done = arrives | moved.over
    last, seen, waiting = moved.observation, moved.observation, moved.arrived
    if moved.over:
        seen, waiting = arena.reset(), np.zeros_like(waits)
    return seen, moved.reward.astype(np.float32), done, truncated, last, waiting


class Workers:
    """Processes that simulate arenas; each robot is an environment."""

    def __init__(self, given: Sb3Config, judged: EvaluateConfig) -> None:
        """Starts the processes."""
        context = multiprocessing.get_context("spawn")
        each = given.arenas // given.workers
        self._pipes: list[Any] = []
        for i in range(given.workers):
            mine, theirs = context.Pipe()
            numbers = range(i * each, (i + 1) * each)
            context.Process(target=serve, args=(theirs, judged, numbers), daemon=True).start()
            self._pipes.append(mine)
        self.first = np.concatenate([pipe.recv() for pipe in self._pipes])

    def send(self, actions: np.ndarray) -> None:
        """Sends the actions [A R, 2] of a control step to all arenas."""
        for pipe, part in zip(self._pipes, np.split(actions, len(self._pipes)), strict=True):
            pipe.send(part)

    def receive(self) -> list[np.ndarray]:
        """Receives the results of `_step` for all robots, except which robots wait."""
        found = [pipe.recv() for pipe in self._pipes]
        return [np.concatenate([each[i] for each in found]) for i in range(5)]

    def close(self) -> None:
        """Ends the processes."""
        for pipe in self._pipes:
            pipe.send(None)


def vectorised(workers: Workers) -> Any:
    """Wraps the arenas in the interface of Stable-Baselines3.

    The class is defined in this function, since Stable-Baselines3 may not be installed.
    """
    spaces = peers.find("gymnasium.spaces", peers.TORCH)
    base = peers.find("stable_baselines3.common.vec_env", peers.TORCH).VecEnv
    box = spaces.Box(-np.inf, np.inf, workers.first.shape[-1:], np.float32)
    command = spaces.Box(-1.0, 1.0, (mujoco_arena.ACTION_SIZE,), np.float32)

    def step_wait(self: Any) -> tuple[Any, ...]:
        seen, reward, done, truncated, last = workers.receive()
        infos: list[dict[str, Any]] = [{} for _ in done]
        for i in np.flatnonzero(done):
            infos[i] = {"terminal_observation": last[i], "TimeLimit.truncated": bool(truncated[i])}
        return seen, reward, done, infos

    members = {
        "reset": lambda self: workers.first,
        "step_async": lambda self, actions: workers.send(actions),
        "step_wait": step_wait,
        "close": lambda self: workers.close(),
        "get_attr": lambda self, name, indices=None: [None] * self.num_envs,
        "set_attr": lambda self, name, value, indices=None: None,
        "env_method": lambda self, name, *given, **named: [],
        "env_is_wrapped": lambda self, wrapper, indices=None: [False] * self.num_envs,
    }
    return type("SwarmVecEnv", (base,), members)(len(workers.first), box, command)


def ppo_settings(robots: int) -> dict[str, Any]:
    """Returns the settings of `algo=ppo` for Stable-Baselines3, with `robots` robots in total."""
    trained = load_train(["stage=s6"])
    algo = trained.algo
    return {
        "n_steps": algo.rollout_length,
        "batch_size": robots * algo.rollout_length // algo.num_minibatches,
        "n_epochs": algo.epochs,
        "gamma": algo.discount,
        "gae_lambda": algo.gae_lambda,
        "clip_range": algo.clip_epsilon,
        "learning_rate": optimizer.learning_rates(algo, trained.updates)["actor"],
        "vf_coef": algo.value_cost,
        "ent_coef": algo.entropy_cost,
        "max_grad_norm": algo.max_grad_norm,
        "policy_kwargs": {
            "net_arch": list(algo.hidden_sizes),
            "log_std_init": np.log(algo.initial_std),
        },
        "seed": 0,
    }


def results(given: Sb3Config, words: list[str]) -> Iterator[dict[str, Any]]:
    """Trains until enough iterations are timed; yields the JSON line."""
    sb3, torch = peers.find("stable_baselines3", peers.TORCH), peers.find("torch", peers.TORCH)
    judged = mujoco_arena.load_settings(["stage=s6", "robot=planar", "steps=500", *words])
    workers = Workers(given, judged)
    chosen = ppo_settings(len(workers.first))
    model = sb3.PPO("MlpPolicy", vectorised(workers), device="cpu", **chosen)
    batch = len(workers.first) * chosen["n_steps"]
    calls_s: list[float] = []
    for i in itertools.count():
        began = time.perf_counter()
        model.learn(batch, reset_num_timesteps=i == 0)
        calls_s.append(time.perf_counter() - began)
        if sum(calls_s[1:]) >= given.seconds:
            break
    workers.close()
    calls_s = calls_s[1:]
    rate = chosen["n_steps"] * given.arenas * len(calls_s) / sum(calls_s)
    yield {
        "benchmark": "cpu_sb3",
        "trainer": "Stable-Baselines3 PPO, MuJoCo C",
        "robot": judged.robot.body,
        "arenas": given.arenas,
        "robots": judged.stage.robots,
        "workers": given.workers,
        "arena_steps_per_s": rate,
        "robot_steps_per_s": rate * judged.stage.robots,
        "transitions_per_s": rate * judged.stage.robots,
        "compile_s": None,
        **timing.spread(calls_s),
        "settings": to_dict(given) | {"ppo": chosen},
        "device": peers.torch_device_name(torch, "cpu"),
        "versions": peers.versions("torch", "stable-baselines3", "gymnasium"),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    mine, rest = key_value.parse(Sb3Config, arguments)
    peers.write(results(mine, rest))
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("cpu_sb3", main, Sb3Config))
