"""Runs the pieces of an extension in an arena, and checks that they fit the arena."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.config import ConfigError
from swarmjax.config.foreign_code import explained
from swarmjax.extension import LevelDrawing, Observation, Piece
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.gaps import KINDS
from swarmjax.task import electronics, level
from swarmjax.task.electronics import Sight
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


def draw(uniforms: Any, stage: Stage, spacing: Spacing, drawings: Sequence[LevelDrawing]) -> Level:
    """Draws a level of a stage with JAX, using the stage's extension drawing if it has one.

    Args:
      uniforms: uniform numbers, as `level.sample` takes them.
      stage: fields [].
      spacing: sizes.
      drawings: extension drawings; `stage.drawing` counts them from 1.

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
            f"{label(piece)} changes the sizes of obstacles: leave obstacle[:, 3:] as it is, and "
            "set the stage's obstacle_size."
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
      ConfigError: a piece returns a wrong shape or type; the message gives the right one.
    """
    drawn = level_shapes(robots, obstacles)
    seen = view_shapes(drawn, robot)
    for piece in chosen.observations:
        shapes = [(robots, piece.size)] + ([(robots,)] if piece.size == 1 else [])
        _check_floats(piece, shapes, seen)
    for piece, _ in chosen.terms:
        _check_floats(piece, [(robots,)], _step(seen.infrared, robot.sensor_range))
    for piece in chosen.drawings:
        _check_drawing(piece, drawn)


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


def view_shapes(drawn: Level, robot: RobotConfig) -> View:
    """Returns the shapes of a view's fields, in a level of these shapes."""
    robots = drawn.present.shape[0]
    sight = Sight(_shape(robots, len(robot.sensor_poses)), None, _shape(robots), _shape(robots))
    there, clock = _shape(robots, dtype=bool), _shape(dtype=jnp.int32)
    return electronics.view(sight, drawn.start, drawn, there, clock)


def level_shapes(robots: int, obstacles: int) -> Level:
    """Returns the shapes of a level's fields."""
    return Level(
        side=_shape(),
        present=_shape(robots, dtype=bool),
        start=_shape(robots, 3),
        target=_shape(robots, 2),
        obstacle_present=_shape(obstacles, dtype=bool),
        obstacle=_shape(obstacles, 5),
        seed=_shape(dtype=jnp.uint32),
    )
