"""One arena of MuJoCo's C engine as an environment for trainers that know nothing of JAX.

The arena is the judge's (`swarmjax.evaluate.engine_c`), with the reward of `task.reward` in
NumPy. The judge asks a policy for actions; here that is one of a learner for each robot, of weight
0, whose bias is the action.
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
from swarmjax.task import observation
from swarmjax.task.config import resolve_encoding
from swarmjax.task.stage_files import load_levels

ACTION_SIZE = 2


class Moved(NamedTuple):
    """What a control step came to.

    Attributes:
      observation: [R, O].
      reward: [R]; 0 for a robot that had arrived before.
      arrived: [R] whether the robot has arrived.
      over: whether all robots have, or the time is out.
    """

    observation: np.ndarray
    reward: np.ndarray
    arrived: np.ndarray
    over: bool


class MujocoArena:
    """One arena; `reset` begins the next level, `step` moves it on.

    Attributes:
      judge: what holds for all of its levels.
      arenas: [A=1] the arena as it stands; None before the first level.
    """

    def __init__(self, settings: EvaluateConfig, first: int = 0) -> None:
        """Compiles it.

        Args:
          settings: of an evaluation: stage, robot, task, realism, substeps and seed of the levels.
          first: number of the first level.

        Raises:
          ConfigError: if the reward has a term that `rewards` does not know, or robots go on after
            arrival.
        """
        if settings.task.arrival != "latch":
            raise ConfigError(f"task.arrival is {settings.task.arrival}: give latch.")
        for name in ("arrival", "robot_contact", "path_progress"):
            weight = getattr(settings.task.reward, name)
            if weight:
                raise ConfigError(f"task.reward.{name} is {weight}: give 0.")
        robots = settings.stage.robots
        told = replace(settings, action="mean")  # what it is told, and nothing drawn beside it
        self.judge = engine_c.load(told, _puppet(told, np.zeros((robots, ACTION_SIZE))))
        self._number = first
        self.arenas: Arenas | None = None

    def reset(self) -> np.ndarray:
        """Begins the next level; returns what its robots observe, [R, O]."""
        level = engine_c.draw_level(
            self.judge.stage, self.judge.spacing, self.judge.config.seed, self._number
        )
        self._number += 1
        self.arenas = engine_c.start(self.judge, [level])
        return self.arenas.observation[0]

    def step(self, action: np.ndarray) -> Moved:
        """Moves the arena on by one control step.

        Args:
          action: [R, 2], -1..1 spans the command's range, what is beyond is clipped.

        Returns:
          What it came to. The arena must be reset where it is over.
        """
        before = self.arenas
        assert before is not None  # reset comes first
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
    """A policy that does what it is told, [R, 2]."""
    robots, none = len(action), np.zeros((len(action), observation.SIZE), np.float32)
    encoding = resolve_encoding(settings.task, settings.realism)
    return Policy(
        layers=[(np.zeros((robots, observation.SIZE, ACTION_SIZE), np.float32), action)],
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
    """The reward of a control step, as `task.reward` adds it up in JAX.

    Args:
      judge: what the arenas share.
      before: [A].
      after: [A], a control step later.

    Returns:
      [A, R]; 0 for robots that had arrived before.
    """
    weights, active = judge.config.task.reward, ~before.outcome.arrived
    way = [observation.to_target(each.pose, each.target, np)[0] for each in (before, after)]
    sensed = after.outcome.sensed - before.outcome.sensed
    begun = (after.outcome.contacts - before.outcome.contacts).sum(axis=-1)
    total = weights.progress * (way[0] - way[1]) + weights.proximity * sensed
    return np.where(active, total + weights.contact * begun + weights.step_penalty, 0.0)


def load_settings(words: list[str]) -> EvaluateConfig:
    """Makes the settings of an arena of `key=value` words of `swarmjax.evaluate`."""
    return load_levels(EvaluateConfig, ["policy=none", *words])
