"""Runs the pieces of an extension in an arena, and checks that they fit the arena."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.config import ConfigError, show
from swarmjax.config.foreign_code import explained
from swarmjax.extension import LevelDrawing, Observation, OwnGoal, Piece
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.gaps import KINDS
from swarmjax.task import electronics, level
from swarmjax.task.electronics import Sight
from swarmjax.task.goals.goal import ENDS, Goal, Turn
from swarmjax.task.level import Level, Spacing
from swarmjax.task.observation import View
from swarmjax.task.pieces import Chosen
from swarmjax.task.reward import Step
from swarmjax.task.stage import Stage


def look(own: Sequence[Observation], view: View) -> Array:
    """Computes the observations of an extension in one arena.

    Args:
      own: the observations.
      view: view of the arena.

    Returns:
      [R, E] in their own units, concatenated in order.
    """
    robots = len(view.pose)
    found = [jnp.reshape(each.function(view), (robots, each.size)) for each in own]
    return jnp.concatenate(found, axis=-1).astype(jnp.float32)


class SideBySide(Goal):
    """A goal of an extension, for the judge: NumPy arrays of many arenas in and out."""

    def __init__(self, own: Goal) -> None:
        """Takes the goal."""
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


def draw(uniforms: Any, stage: Stage, spacing: Spacing, drawings: Sequence[LevelDrawing]) -> Level:
    """Draws a level of a stage with JAX, using the stage's extension drawing if it has one.

    Args:
      uniforms: uniform numbers, as `level.sample` takes them.
      stage: fields [].
      spacing: sizes.
      drawings: extension drawings, in the order that `stage.drawing` counts.

    Returns:
      The level; absent robots and obstacles are parked outside.
    """
    drawn = level.sample(uniforms, stage, spacing, jnp)
    if not drawings:
        return drawn
    key, found = jax.random.key(drawn.seed), drawn
    for number, piece in enumerate(drawings, 1):
        mine = stage.drawing == number
        pairs = zip(piece.function(drawn, key), found, strict=True)
        found = Level(*(jnp.where(mine, own, other) for own, other in pairs))
    return level.park(found, jnp)


def redraw(piece: LevelDrawing, drawn: Level) -> Level:
    """Draws a level of one arena with an extension's drawing, for an evaluation in NumPy.

    Args:
      piece: the level drawing.
      drawn: the level as drawn without the extension.

    Returns:
      The level, as NumPy arrays; absent robots and obstacles are parked outside.

    Raises:
      ConfigError: the drawing changes obstacle sizes, which are fixed in the compiled model.
    """
    with explained(f"{label(piece)} fails"):
        own = _compiled(piece)(drawn)
    found = level.park(Level(*(np.asarray(field) for field in own)), np)
    if not np.array_equal(found.obstacle[:, 3:], drawn.obstacle[:, 3:]):
        raise ConfigError(
            f"{label(piece)} changes the half edges of obstacles: leave obstacle[:, 3:] as it is, "
            "and give the stage's obstacle_size."
        )
    return found


@functools.lru_cache(maxsize=16)
def _compiled(piece: LevelDrawing) -> Callable[[Level], Level]:
    return jax.jit(lambda drawn: piece.function(drawn, jax.random.key(drawn.seed)))


def check(chosen: Chosen, robot: RobotConfig, robots: int, obstacles: int) -> None:
    """Refuses pieces that return a wrong shape or type; compiles nothing.

    Args:
      chosen: the pieces.
      robot: the robot.
      robots: R.
      obstacles: M.

    Raises:
      ConfigError: a piece returns something else; the message says what it should return.
    """
    drawn, there, whole = (
        _level(robots, obstacles),
        _shape(robots, dtype=bool),
        _shape(dtype=jnp.int32),
    )
    infrared = _shape(robots, len(robot.sensor_poses))
    sight = Sight(infrared, None, _shape(robots), _shape(robots))
    seen = electronics.view(sight, drawn.start, drawn, there, whole)
    for piece in chosen.observations:
        shapes = [(robots, piece.size)] + ([(robots,)] if piece.size == 1 else [])
        _check_floats(piece, shapes, seen)
    for piece, _ in chosen.terms:
        _check_floats(piece, [(robots,)], _step(infrared, robot.sensor_range))
    for piece in chosen.drawings:
        _check_drawing(piece, drawn)


def check_goal(piece: OwnGoal, goal: Goal, robot: RobotConfig, robots: int, obstacles: int) -> None:
    """Refuses a goal without measures, or whose turns have a wrong shape or type.

    Args:
      piece: the goal of the extension.
      goal: the goal, made with the sizes of the task.
      robot: the robot.
      robots: R.
      obstacles: M.

    Raises:
      ConfigError: the goal returns something else; the message says what it should return.
    """
    if not isinstance(goal, Goal) or not goal.measures:
        raise ConfigError(
            f"{label(piece)} measures nothing: make it a class of "
            "swarmjax.task.goals.goal.Goal, and give it measures = {name: Measure(label, unit)}."
        )
    if goal.ends not in ENDS:
        raise ConfigError(f"{label(piece)} has ends {show(goal.ends)}: give {', '.join(ENDS)}.")
    drawn, there = _level(robots, obstacles), _shape(robots, dtype=bool)
    sight = Sight(_shape(robots, len(robot.sensor_poses)), None, _shape(robots), _shape(robots))
    view = electronics.view(sight, drawn.start, drawn, there, _shape(dtype=jnp.int32))
    with explained(f"{label(piece)} fails"):
        state, first = jax.eval_shape(goal.begin, drawn)
        turn = jax.eval_shape(goal.advance, state, drawn, view)
    if {*turn.measured} != {*goal.measures}:
        raise ConfigError(
            f"{label(piece)} measures {', '.join(turn.measured) or 'nothing'}: return a Turn whose "
            f"measured has {', '.join(goal.measures)}."
        )
    wanted = {
        "target of begin": (first, (robots, 2), jnp.float32),
        "target": (turn.target, (robots, 2), jnp.float32),
        "arrived": (turn.arrived, (robots,), bool),
        "earns": (turn.arrived if turn.earns is None else turn.earns, (robots,), bool),
        **{f"measured {name}": (each, (), each.dtype) for name, each in turn.measured.items()},
    }
    for name, (value, shape, dtype) in wanted.items():
        if (value.shape, value.dtype) != (shape, dtype):
            raise ConfigError(
                f"{label(piece)} returns {name} as {value.dtype} of shape {list(value.shape)}: "
                f"return {jnp.dtype(dtype)} of shape {list(shape)}."
            )
    before, after = (
        jax.tree.map(lambda x: (x.shape, x.dtype), each) for each in (state, turn.state)
    )
    if before != after:
        raise ConfigError(
            f"{label(piece)} returns another state from advance than from begin: return arrays of "
            f"the same shapes and types, here {before}."
        )


def _check_floats(piece: Piece, shapes: list[tuple[int, ...]], argument: Any) -> None:
    """Refuses a piece that does not return floats of one of these shapes."""
    found = _trace(piece, argument)
    if not isinstance(found, jax.ShapeDtypeStruct):
        what = type(found).__name__
    elif found.shape in shapes and jnp.issubdtype(found.dtype, jnp.floating):
        return
    else:
        what = f"{found.dtype} of shape {list(found.shape)}"
    wanted = f"float numbers of shape {' or '.join(str(list(shape)) for shape in shapes)}"
    raise ConfigError(f"{label(piece)} returns {what}: return {wanted}.")


def _check_drawing(piece: LevelDrawing, drawn: Level) -> None:
    """Refuses a drawing that does not return a valid level."""
    found = _trace(piece, drawn, jax.eval_shape(jax.random.key, 0))
    if not isinstance(found, Level):
        raise ConfigError(
            f"{label(piece)} returns {type(found).__name__}: return level._replace(...)."
        )
    for name, before, after in zip(Level._fields, drawn, found, strict=True):
        if (before.shape, before.dtype) != (after.shape, after.dtype):
            raise ConfigError(
                f"{label(piece)} returns {name} as {after.dtype} of shape {list(after.shape)}: "
                f"return {before.dtype} of shape {list(before.shape)}."
            )


def _trace(piece: Piece, *arguments: Any) -> Any:
    """Returns the shapes that a piece returns."""
    with explained(f"{label(piece)} fails"):
        return jax.eval_shape(piece.function, *arguments)


def label(piece: Piece) -> str:
    """Returns the file that defines a piece, followed by the kind and the name of the piece."""
    code = getattr(piece.function, "__code__", None)
    file = f"{code.co_filename}: " if code is not None else ""
    return f"{file}{piece.kind} {piece.name}"


def _shape(*shape: int, dtype: Any = jnp.float32) -> Any:
    return jax.ShapeDtypeStruct(shape, dtype)


def _step(infrared: Any, sensor_range: float) -> Step:
    robots = infrared.shape[0]
    there, kinds = _shape(robots, dtype=bool), _shape(robots, len(KINDS), dtype=bool)
    distance, pose = _shape(robots), _shape(robots, 3)
    return Step(
        distance_before=distance,
        distance=distance,
        infrared=infrared,
        sensor_range=sensor_range,
        arrives=there,
        contact_begins=kinds,
        touching=kinds,
        outside=there,
        pose_before=pose,
        pose=pose,
        action=_shape(robots, 2),
        present=there,
        clock=_shape(dtype=jnp.int32),
    )


def _level(robots: int, obstacles: int) -> Level:
    return Level(
        side=_shape(),
        present=_shape(robots, dtype=bool),
        start=_shape(robots, 3),
        target=_shape(robots, 2),
        obstacle_present=_shape(obstacles, dtype=bool),
        obstacle=_shape(obstacles, 5),
        seed=_shape(dtype=jnp.uint32),
    )
