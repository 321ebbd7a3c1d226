"""Checks goals of an extension, and adapts them to the judge."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.config import ConfigError, show
from swarmjax.config.foreign_code import explained
from swarmjax.extension import OwnGoal
from swarmjax.sim.config import RobotConfig
from swarmjax.task import extended
from swarmjax.task.goals.goal import ENDS, Goal, Measure, Turn
from swarmjax.task.level import Level
from swarmjax.task.observation import View

# Methods that a goal must not override, because judge and training would no longer agree.
_FIXED = ("turn", "drives", "is_under_way", "is_over", "terminates", "measured")


class SideBySide(Goal):
    """A goal of an extension, for the judge: takes and returns NumPy arrays of many arenas."""

    def __init__(self, own: Goal) -> None:
        """Wraps the goal of the extension."""
        super().__init__(own.sizes)
        self.ends, self.moves, self.measures = own.ends, own.moves, own.measures
        self._begin = jax.jit(jax.vmap(own.begin))
        self._advance = jax.jit(jax.vmap(own.advance))

    def begin(self, level: Level) -> tuple[Any, Any]:
        """See `Goal.begin`."""
        return jax.tree.map(np.asarray, self._begin(level))

    def advance(self, state: Any, level: Level, view: View) -> Turn:
        """See `Goal.advance`."""
        return jax.tree.map(np.asarray, self._advance(state, level, view))


def check(piece: OwnGoal, goal: Goal, robot: RobotConfig, robots: int, obstacles: int) -> None:
    """Refuses a goal without measures, or whose turns have a wrong shape or type.

    Args:
      piece: the goal of the extension.
      goal: the goal, made with the sizes of the task.
      robot: the robot.
      robots: R.
      obstacles: M.

    Raises:
      ConfigError: the goal is invalid; the message says how to correct it.
    """
    name = extended.label(piece)
    _check_class(name, goal)
    drawn = extended.level_shapes(robots, obstacles)
    view = extended.view_shapes(drawn, robot)
    with explained(f"{name} fails"):
        state, first = jax.eval_shape(goal.begin, drawn)
        found = jax.eval_shape(goal.advance, state, drawn, view)
    if not isinstance(found, Turn) or not isinstance(found.measured, Mapping):
        raise ConfigError(f"{name} returns no Turn from advance: return Turn(state, target, ...).")
    if {*found.measured} != {*goal.measures}:
        raise ConfigError(
            f"{name} returns a Turn that measures {', '.join(found.measured) or 'nothing'}: return "
            f"a Turn that measures {', '.join(goal.measures)}."
        )
    _check_shapes(name, first, found, robots)
    _check_state(name, state, found.state)


def _check_class(name: str, goal: Goal) -> None:
    """Refuses a class that measures nothing, or overrides a method of `_FIXED`."""
    measures = goal.measures
    if not measures or not all(isinstance(each, Measure) for each in measures.values()):
        raise ConfigError(
            f"{name} has no measures: add measures = {{name: Measure(label, unit)}} to the class."
        )
    if goal.ends not in ENDS:
        raise ConfigError(f"{name} has ends {show(goal.ends)}: give one of {', '.join(ENDS)}.")
    for each in _FIXED:
        if getattr(type(goal), each) is not getattr(Goal, each):
            raise ConfigError(f"{name} defines {each}, which goals must not change: rename it.")


def _check_shapes(name: str, first: Any, turn: Turn, robots: int) -> None:
    """Refuses a turn whose arrays have wrong shapes or types."""
    place, each = ((robots, 2), jnp.float32), ((robots,), bool)
    wanted = {"target of begin": (first, *place), "target": (turn.target, *place)}
    wanted |= {"arrived": (turn.arrived, *each)}
    wanted |= {} if turn.earns is None else {"earns": (turn.earns, *each)}
    wanted |= {f"measured {key}": (x, (), x.dtype) for key, x in turn.measured.items()}
    for what, (value, shape, dtype) in wanted.items():
        if (value.shape, value.dtype) != (shape, dtype):
            raise ConfigError(
                f"{name} returns {what} as {value.dtype} of shape {list(value.shape)}: "
                f"return {jnp.dtype(dtype)} of shape {list(shape)}."
            )


def _check_state(name: str, before: Any, after: Any) -> None:
    """Refuses a state that changes its shapes, or is neither an array nor a tuple of arrays."""
    if not _is_plain(before):
        raise ConfigError(
            f"{name} has a {type(before).__name__} as state: return an array or a tuple of arrays."
        )
    shapes = [jax.tree.map(lambda x: (x.shape, x.dtype.name), each) for each in (before, after)]
    if shapes[0] != shapes[1]:
        raise ConfigError(
            f"{name} returns a state from advance that differs from that of begin: return arrays "
            f"of the same shapes and types, here {shapes[0]}."
        )


def _is_plain(state: Any) -> bool:
    if isinstance(state, tuple):
        return all(map(_is_plain, state))
    return isinstance(state, jax.ShapeDtypeStruct)
