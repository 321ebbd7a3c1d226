"""How fast does the paper's way train our robots in MuJoCo C?

`python -m benchmarks.peers who=paper_way [seconds=30] [key=value ...]` takes the keys of
`swarmjax.evaluate` and needs the packages in `torch-peers.txt`. After one warm-up, it times whole
cycles of rollout and update until `seconds` have passed.

`paper_way` is the paper's way to train: PPO-PyTorch's update on one arena, with the settings of
`algo=paper`. The program is a rewrite of nikhilbarhate99/PPO-PyTorch (commit 728cce8). Each robot
has its own actor and critic and computes its action separately. Returns are Monte Carlo sums and
are normalised. After every `rollout` control steps, each pair of networks takes `epochs`
optimiser steps (80 by default) on the whole rollout.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks import lines, mujoco_arena, peers
from benchmarks.lines import Line
from benchmarks.mujoco_arena import Moved, MujocoArena
from swarmjax.config import Section, about, to_dict
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.load_settings import load_train
from swarmjax.sim import drive
from swarmjax.task import observation

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
        self._actor = _network(torch, algo.hidden_sizes, drive.ACTION_SIZE, last=torch.nn.Tanh())
        self._critic = _network(torch, algo.hidden_sizes, 1)
        rates = ((self._actor, algo.actor_learning_rate), (self._critic, algo.critic_learning_rate))
        self._optimizer = torch.optim.Adam(
            [{"params": net.parameters(), "lr": rate} for net, rate in rates]
        )
        self._variance = torch.full((drive.ACTION_SIZE,), algo.initial_std**2)
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
    none = np.zeros(drive.ACTION_SIZE, np.float32)
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
