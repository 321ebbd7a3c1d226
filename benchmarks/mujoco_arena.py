"""Provides one arena of MuJoCo's C engine as an environment for trainers without JAX.

The judge in `swarmjax.evaluate.engine_c` simulates the arena. This file adds the reward of
`task.reward`, in NumPy. The judge takes its actions from a policy, so this file wraps each action
in a policy: one learner per robot, with zero weights and with the robot's action as bias.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.evaluate import engine_c
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.engine_c import Arenas
from swarmjax.evaluate.judge import Judge
from swarmjax.policy import Policy
from swarmjax.sim.drive import ACTION_SIZE
from swarmjax.task import observation
from swarmjax.task.config import resolve_encoding
from swarmjax.task.stage_files import load_levels


class Moved(NamedTuple):
    """The result of a control step.

    Attributes:
      observation: [R, O] observations.
      reward: [R] rewards; 0 for a robot that had arrived in an earlier step.
      arrived: [R] whether the robot has arrived.
      over: whether all robots have arrived, or the time is up.
    """

    observation: np.ndarray
    reward: np.ndarray
    arrived: np.ndarray
    over: bool


class MujocoArena:
    """A single arena: `reset` begins the next level, and `step` takes a control step.

    Attributes:
      judge: the settings, the compiled model and other data that all levels share.
      arenas: [A=1] current state of the arena; None before the first level.
    """

    def __init__(self, settings: EvaluateConfig) -> None:
        """Compiles the arena.

        Args:
          settings: stage, robot, task, realism, substeps and seed of the levels.

        Raises:
          ConfigError: if `rewards` does not support a term of the reward, or robots keep driving
            after arrival.
        """
        if settings.task.arrival != "latch":
            raise ConfigError(f"task.arrival is {settings.task.arrival}: give latch.")
        if settings.task.goal != "navigate":
            raise ConfigError(f"task.goal is {settings.task.goal}: give navigate.")
        for name in ("arrival", "path_progress"):
            weight = getattr(settings.task.reward, name)
            if weight:
                raise ConfigError(f"task.reward.{name} is {weight}: give 0.")
        robots = settings.stage.robots
        told = replace(settings, action="mean")  # exactly the given action, without sampling
        self.judge = engine_c.load(told, _puppet(told, np.zeros((robots, ACTION_SIZE))))
        self._number = 0
        self.arenas: Arenas | None = None

    def reset(self) -> np.ndarray:
        """Begins the next level; returns its robots' observations [R, O]."""
        level = engine_c.draw_level(
            self.judge.stage, self.judge.spacing, self.judge.config.seed, self._number
        )
        self._number += 1
        self.arenas = engine_c.start(self.judge, [level])
        return self.arenas.observation[0]

    def step(self, action: np.ndarray) -> Moved:
        """Advances the arena by one control step.

        Args:
          action: [R, 2] actions; -1..1 spans the command's range, larger values are clipped.

        Returns:
          The result of the step. If its `over` is true, `reset` must be called next.
        """
        before = self.arenas
        assert before is not None  # `reset` must be called first
        puppet = _puppet(self.judge.config, action)
        after = engine_c.step(replace(self.judge, policy=puppet), before)
        self.arenas = after
        arrived = after.outcome.arrived[0]
        timeout = after.outcome.clock[0] >= self.judge.config.step_limit
        return Moved(
            observation=after.observation[0],
            reward=rewards(self.judge, before, after)[0],
            arrived=arrived,
            over=bool(arrived.all() or timeout),
        )


def _puppet(settings: EvaluateConfig, action: np.ndarray) -> Policy:
    """Makes a policy that always takes the given actions [R, 2]."""
    encoding = resolve_encoding(settings.task, settings.realism)
    robots, size = len(action), observation.LAYOUTS[encoding].size
    none = np.zeros((robots, size), np.float32)
    return Policy(
        layers=[(np.zeros((robots, size, ACTION_SIZE), np.float32), action)],
        log_std=np.zeros_like(action),
        mean=none,
        std=none + 1.0,
        is_shared=False,
        encoding=encoding,
        max_speed=settings.robot.max_speed,
        max_turn_rate=settings.robot.max_turn_rate,
        meta={
            "activation": "tanh",
            "observation": observation.describe(encoding) | {"limit": 10.0},
        },
        digest="",
    )


def rewards(judge: Judge, before: Arenas, after: Arenas) -> np.ndarray:
    """Computes the reward of a control step, as `task.reward` does in JAX.

    Args:
      judge: the data that the arenas share.
      before: [A] arenas before the control step.
      after: [A] arenas after the control step.

    Returns:
      [A, R] rewards; 0 for robots that had arrived before the control step.
    """
    weights, active = judge.config.task.reward, ~before.outcome.arrived
    way = [observation.to_target(each.pose, each.target, np)[0] for each in (before, after)]
    sensed = after.outcome.sensed - before.outcome.sensed
    begun = (after.outcome.contacts - before.outcome.contacts).sum(axis=-1)
    total = weights.progress * (way[0] - way[1]) + weights.proximity * sensed
    return np.where(active, total + weights.contact * begun + weights.step_penalty, 0.0)


def load_settings(words: list[str]) -> EvaluateConfig:
    """Makes the settings of an arena from `key=value` arguments of `swarmjax.evaluate`."""
    return load_levels(EvaluateConfig, ["policy=none", *words])
