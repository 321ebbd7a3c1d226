"""Finds the goal that `task.goal` names."""

from collections.abc import Sequence

from swarmjax.config import ConfigError, show
from swarmjax.extension import OwnGoal
from swarmjax.sim.config import RobotConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.goals.cover import Cover
from swarmjax.task.goals.gather import Gather
from swarmjax.task.goals.goal import Goal, GoalSizes
from swarmjax.task.goals.lifelong import Lifelong
from swarmjax.task.goals.navigate import Moving, Navigate

GOALS = {"lifelong": Lifelong, "gather": Gather, "cover": Cover}


def load(task: TaskConfig, robot: RobotConfig, own: Sequence[OwnGoal] = ()) -> Goal:
    """Makes the goal of a task.

    Args:
      task: names the goal.
      robot: the robot.
      own: goals of an extension.

    Returns:
      The goal.

    Raises:
      ConfigError: there is no such goal.
    """
    sizes = GoalSizes(
        control_step=task.control_step,
        target_radius=task.target_radius,
        target_speed=task.target_speed,
        hull_radius=robot.hull_radius,
        sensor_range=robot.sensor_range,
    )
    if task.goal == "navigate":
        return (Moving if task.target_speed else Navigate)(sizes, task.arrival)
    there = GOALS | {piece.name: piece.function for piece in own}
    if task.goal not in there:
        raise ConfigError(
            f"task.goal is {show(task.goal)}: give one of {', '.join(('navigate', *there))}, or "
            "add extensions=FILE, the Python file that defines this goal."
        )
    cls = there[task.goal]
    if not (isinstance(cls, type) and issubclass(cls, Goal)):
        raise ConfigError(f"goal {task.goal} is not a subclass of swarmjax.task.goals.goal.Goal.")
    return cls(sizes)
