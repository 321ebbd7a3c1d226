"""How fast do trainers without JAX train our robots in MuJoCo C?

`python -m benchmarks.peers who=sb3|paper_way [seconds=30] [key=value ...]` takes the keys of
`swarmjax.evaluate` and needs the packages in `torch-peers.txt`. After one warm-up, it times whole
iterations of rollout and update until `seconds` have passed.

- `sb3` is Stable-Baselines3's PPO on a vectorised environment. Every robot is one environment of
  Stable-Baselines3. All robots share one policy, and `workers` processes simulate the arenas.
  Networks, batch per robot, epochs, minibatches, discount and clip are those of `algo=ppo`.
  Observations are not normalised. Stable-Baselines3 cannot mask samples, so an arrived robot stays
  in the batch with reward 0 until its arena's episode ends.
- `paper_way` is the paper's way to train: PPO-PyTorch's update on one arena, with the settings of
  `algo=paper`. The program is a rewrite of nikhilbarhate99/PPO-PyTorch (commit 728cce8). Each robot
  has its own actor and critic and computes its action separately. Returns are Monte Carlo sums and
  are normalised. After every `rollout` control steps, each pair of networks takes `epochs`
  optimiser steps (80 by default) on the whole rollout.
"""

import itertools
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from benchmarks import lines, mujoco_arena, peers
from benchmarks.lines import Line
from benchmarks.mujoco_arena import Moved, MujocoArena
from swarmjax.config import ConfigError, Section, about, to_dict
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.ppo import optimizer
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.load_settings import load_train
from swarmjax.task import observation

_LEVELS = 1_000_000  # level numbers reserved for each arena
_WARM = 200  # control steps of the warm-up cycle of `paper_way`


def timed(call: Callable[[int], None], seconds: float) -> list[float]:
    """Times calls until all but the first took `seconds` in total; returns the times of all."""
    taken: list[float] = []
    while len(taken) < 2 or sum(taken[1:]) < seconds:
        began = time.perf_counter()
        call(len(taken))
        taken.append(time.perf_counter() - began)
    return taken[1:]


def load_settings(words: Sequence[str]) -> EvaluateConfig:
    """Makes the settings of the arenas from `key=value` arguments of `swarmjax.evaluate`."""
    return mujoco_arena.load_settings(["stage=s6", "robot=planar", "steps=500", *words])


# Stable-Baselines3


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


def sb3(words: Sequence[str]) -> Iterator[Line]:
    """Trains with Stable-Baselines3; yields the JSON line."""
    given, rest = lines.parse(Sb3Config, words)
    library, torch = peers.find("stable_baselines3", peers.TORCH), peers.find("torch", peers.TORCH)
    judged = load_settings(rest)
    workers = Workers(given, judged)
    chosen = ppo_settings(len(workers.first))
    model = library.PPO("MlpPolicy", vectorised(workers), device="cpu", **chosen)
    batch = len(workers.first) * chosen["n_steps"]
    calls_s = timed(lambda i: model.learn(batch, reset_num_timesteps=i == 0), given.seconds)
    workers.close()
    rate = chosen["n_steps"] * given.arenas * len(calls_s) / sum(calls_s)
    yield {
        "benchmark": "cpu_sb3",
        "trainer": "Stable-Baselines3 PPO, MuJoCo C",
        "robot": judged.robot.body,
        "workers": given.workers,
        **peers.training(judged.stage.robots, given.arenas, rate, calls_s),
        "settings": to_dict(given) | {"ppo": chosen},
        **peers.with_torch(torch, "cpu", "stable-baselines3", "gymnasium"),
    }


# The paper's way


@dataclass(frozen=True, kw_only=True)
class PaperWayConfig(Section):
    """Settings: how long to measure, and the steps of a cycle."""

    seconds: float = field(default=30.0, metadata=about("minimum time of all cycles", above=0.0))
    rollout: int = field(default=6000, metadata=about("control steps per cycle", 2, 10**6))
    epochs: int = field(default=80, metadata=about("steps of each optimiser per cycle", 1, 10**4))


class Robot:
    """One robot's actor and critic, their optimiser, and the data of the current cycle."""

    def __init__(self, torch: Any, algo: AlgoConfig) -> None:
        """Makes both networks with PyTorch's default initialisation."""
        self._torch, self._algo = torch, algo
        self._actor = _network(
            torch, algo.hidden_sizes, mujoco_arena.ACTION_SIZE, last=torch.nn.Tanh()
        )
        self._critic = _network(torch, algo.hidden_sizes, 1)
        rates = ((self._actor, algo.actor_learning_rate), (self._critic, algo.critic_learning_rate))
        self._optimizer = torch.optim.Adam(
            [{"params": net.parameters(), "lr": rate} for net, rate in rates]
        )
        self._variance = torch.full((mujoco_arena.ACTION_SIZE,), algo.initial_std**2)
        self.forget()

    def forget(self) -> None:
        """Discards the stored data before a new cycle."""
        self._seen: list[Any] = []
        self._done: list[Any] = []
        self._log_prob: list[Any] = []
        self.reward: list[float] = []
        self.ended: list[bool] = []

    def act(self, seen: np.ndarray) -> np.ndarray:
        """Draws an action for an observation [O]; stores the action and the observation."""
        with self._torch.no_grad():
            state = self._torch.as_tensor(seen)
            chosen = self._distribution(state)
            action = chosen.sample()
            self._log_prob.append(chosen.log_prob(action))
        self._seen.append(state)
        self._done.append(action)
        return action.numpy()

    def _distribution(self, state: Any) -> Any:
        covariance = self._torch.diag(self._variance)
        return self._torch.distributions.MultivariateNormal(self._actor(state), covariance)

    def learn(self, epochs: int) -> None:
        """Takes `epochs` optimiser steps on all stored data."""
        torch, algo = self._torch, self._algo
        seen, done = torch.stack(self._seen), torch.stack(self._done)
        before = torch.stack(self._log_prob)
        returns = torch.tensor(discounted(self.reward, self.ended, algo.discount))
        returns = (returns - returns.mean()) / (returns.std() + 1e-7)
        with torch.no_grad():
            advantage = returns - self._critic(seen)[:, 0]
        for _ in range(epochs):
            chosen = self._distribution(seen)
            ratio = torch.exp(chosen.log_prob(done) - before)
            clipped = torch.clamp(ratio, 1.0 - algo.clip_epsilon, 1.0 + algo.clip_epsilon)
            gain = torch.minimum(ratio * advantage, clipped * advantage)
            error = 0.5 * (self._critic(seen)[:, 0] - returns).square().mean()
            loss = error - (gain + algo.entropy_cost * chosen.entropy()).mean()
            self._optimizer.zero_grad()
            loss.backward()
            self._optimizer.step()


def _network(torch: Any, hidden: Sequence[int], size: int, last: Any = None) -> Any:
    """Makes a network of linear layers with tanh between them, and with `last` at its end."""
    widths, layers = [observation.SIZE, *hidden], []
    for wide, narrow in itertools.pairwise(widths):
        layers += [torch.nn.Linear(wide, narrow), torch.nn.Tanh()]
    layers.append(torch.nn.Linear(widths[-1], size))
    return torch.nn.Sequential(*layers, *([] if last is None else [last]))


def discounted(reward: Sequence[float], ended: Sequence[bool], discount: float) -> np.ndarray:
    """Computes the discounted return of each step, to the end of its episode or of the cycle.

    Args:
      reward: [T] rewards.
      ended: [T] whether the robot's episode ended with the step.
      discount: discount per control step.

    Returns:
      [T] discounted sums.
    """
    total, found = 0.0, np.zeros(len(reward), np.float32)
    for t in reversed(range(len(reward))):
        total = reward[t] + (0.0 if ended[t] else discount * total)
        found[t] = total
    return found


def cycle(arena: MujocoArena, robots: Sequence[Robot], steps: int, epochs: int) -> None:
    """Runs the robots for `steps` control steps from a new level, then trains their networks.

    Args:
      arena: one arena.
      robots: the arena's robots; an arrived robot waits and stores nothing.
      steps: number of control steps.
      epochs: how many steps each optimiser takes.
    """
    seen, drives = arena.reset(), list(robots)
    for _ in range(steps):
        moved, drives = _control_step(arena, robots, drives, seen)
        seen = moved.observation
        if moved.over:
            seen, drives = arena.reset(), list(robots)
    for robot in robots:
        if len(robot.reward) > 1:
            robot.learn(epochs)


def _control_step(
    arena: MujocoArena, robots: Sequence[Robot], drives: Sequence[Robot], seen: np.ndarray
) -> tuple[Moved, list[Robot]]:
    """Takes one control step; returns its results and the robots that have not yet arrived."""
    none = np.zeros(mujoco_arena.ACTION_SIZE, np.float32)
    ask = zip(robots, seen, strict=True)
    action = np.stack([robot.act(each) if robot in drives else none for robot, each in ask])
    moved = arena.step(action)
    for robot, reward, arrived in zip(robots, moved.reward, moved.arrived, strict=True):
        if robot in drives:
            robot.reward.append(float(reward))
            robot.ended.append(bool(arrived or moved.over))
    return moved, [robot for robot, gone in zip(robots, moved.arrived, strict=True) if not gone]


def paper_way(words: Sequence[str]) -> Iterator[Line]:
    """Trains in the paper's way; yields the JSON line."""
    given, rest = lines.parse(PaperWayConfig, words)
    torch = peers.find("torch", peers.TORCH)
    judged, algo = load_settings(rest), load_train(["algo=paper"]).algo
    arena = MujocoArena(judged)
    robots = [Robot(torch, algo) for _ in range(judged.stage.robots)]
    transitions = []

    def train(number: int) -> None:
        for robot in robots:
            robot.forget()
        steps = given.rollout if number else min(_WARM, given.rollout)
        cycle(arena, robots, steps, given.epochs)
        transitions.append(sum(len(robot.reward) for robot in robots))

    calls_s = timed(train, given.seconds)
    rate = given.rollout * len(calls_s) / sum(calls_s)
    yield {
        "benchmark": "cpu_paper_way",
        "trainer": "PPO-PyTorch's way, MuJoCo C, one arena",
        "robot": judged.robot.body,
        "substeps": arena.judge.substeps,
        **peers.training(len(robots), 1, rate, calls_s),
        "transitions_per_s": sum(transitions[1:]) / sum(calls_s),  # arrived robots do not learn
        "settings": to_dict(given) | {"algo": to_dict(algo)},
        **peers.with_torch(torch, "cpu"),
    }
