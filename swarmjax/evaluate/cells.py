"""Cells: sets of levels for judging policies, drawn from numbers or read from a file.

A suite is a list of cells. Each cell has a digest of its levels. By comparing digests, everybody
who draws the levels can check that every bit is the same. Levels of a suite are drawn for the
nominal e-puck.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from swarmjax import epuck, extension, policy
from swarmjax.config import ConfigError, build, check_text, reading, show, to_dict
from swarmjax.evaluate import judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.suite_config import CellConfig, SuiteFileConfig, read_suite
from swarmjax.extension import LevelDrawing
from swarmjax.outputs import replacing
from swarmjax.task import level
from swarmjax.task import stage as task_stage
from swarmjax.task.config import TaskConfig
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig

FORMAT = 2
_TARGET_RADIUS = TaskConfig().target_radius
_LARGEST_HALF = 2.5  # m, largest half edge of a box: longer than half the largest arena


class Cell(NamedTuple):
    """Levels of one kind.

    Attributes:
      name: Name of the cell.
      stage: Settings of the stage.
      realism: Name of a preset, or None for the command's preset.
      seed: Seed of the levels.
      episodes: [E] numbers of the levels.
      levels: [E] levels.
      steps: Control steps of an episode, or None for the command's number.
      hull_friction: Friction of the robots' hulls, or None for the command's value.
    """

    name: str
    stage: StageConfig
    realism: str | None
    seed: int
    episodes: np.ndarray
    levels: Level
    steps: int | None = None
    hull_friction: float | None = None

    @property
    def digest(self) -> str:
        """SHA-256 over the names, types, shapes and bytes of the levels' arrays."""
        return policy.digest(_arrays(self))

    @property
    def half(self) -> np.ndarray:
        """[M, 2] half edges of the first level's boxes, m; boxes of other levels may differ."""
        return self.levels.obstacle[0, :, 3:]

    @property
    def largest_half(self) -> np.ndarray:
        """[M, 2] for each box, the largest half edges that it has in any level, m."""
        return self.levels.obstacle[..., 3:].max(axis=0)


class Suite(NamedTuple):
    """A named list of cells. The name is None if the cells come from a single stage."""

    name: str | None
    cells: tuple[Cell, ...]


def load(config: EvaluateConfig) -> Suite:
    """Draws or reads the levels of an evaluation.

    Args:
      config: Settings of the evaluation.

    Returns:
      The suite that the settings name, or one cell with their stage.

    Raises:
      ConfigError: The suite is unsound, or made for smaller robots or other targets.
    """
    if config.suite is None:
        return Suite(None, (draw_stage(config, range(config.episodes)),))
    if config.robot.hull_radius > epuck.HULL_RADIUS:
        raise ConfigError(
            f"robot.hull_radius is {show(config.robot.hull_radius)}, but suites are drawn for "
            f"{epuck.HULL_RADIUS}: give at most that."
        )
    if config.task.target_radius != _TARGET_RADIUS:
        raise ConfigError(
            f"task.target_radius is {show(config.task.target_radius)}, but suites are drawn for "
            f"{_TARGET_RADIUS}: give that."
        )
    if Path(config.suite).suffix == ".npz":
        return read(Path(config.suite))
    return draw(config.suite)


def stages(config: EvaluateConfig) -> list[StageConfig]:
    """Lists the stages of an evaluation before drawing levels; none for a file of levels."""
    if config.suite is None:
        return [config.stage]
    if Path(config.suite).suffix == ".npz":
        return []
    return [cell.stage for cell in read_suite(config.suite).cells]


def draw(choice: str) -> Suite:
    """Draws the levels of a suite and checks their digests.

    Args:
      choice: A name of configs/suites/, or the path of a .yaml file.

    Returns:
      The suite.

    Raises:
      ConfigError: The file is unsound, or a digest is missing or wrong.
    """
    file = read_suite(choice)
    drawn = []
    for each in file.cells:
        if each.digest is None:
            raise ConfigError(
                f"cell {each.name} of suite {file.name} has no digest: draw it with "
                f"python -m swarmjax.suite suite={choice} write=true."
            )
        drawn.append(draw_cell(each))
        _check_digest(drawn[-1], each.digest, f"suite {file.name}")
    return Suite(file.name, tuple(drawn))


def draw_stage(config: EvaluateConfig, numbers: Sequence[int]) -> Cell:
    """Draws levels of an evaluation's stage, for its robot and targets.

    Args:
      config: Settings of the evaluation; its suite is ignored.
      numbers: [E] numbers of the levels.

    Returns:
      The cell, under the stage's name.
    """
    stage, radii = config.stage, (config.robot.hull_radius, config.task.target_radius)
    drawings = extension.load(config.extensions).levels
    levels = _draw(stage, config.seed, numbers, radii, drawings)
    return Cell(stage.name, stage, None, config.seed, np.array(numbers), levels)


def draw_cell(cell: CellConfig) -> Cell:
    """Draws the levels of a suite's cell, without checking the cell's digest."""
    numbers, radii = cell.episodes or range(cell.levels), (epuck.HULL_RADIUS, _TARGET_RADIUS)
    levels = _draw(cell.stage, cell.seed, numbers, radii)
    return _cell(cell, np.array(numbers), levels)


def _cell(cell: CellConfig, episodes: np.ndarray, levels: Level) -> Cell:
    about = (cell.name, cell.stage, cell.realism, cell.seed)
    return Cell(*about, episodes, levels, cell.steps, cell.hull_friction)


def _draw(
    stage: StageConfig,
    seed: int,
    numbers: Sequence[int],
    radii: tuple[float, float],
    drawings: Sequence[LevelDrawing] = (),
) -> Level:
    """Draws levels with these numbers, for hulls and targets with these radii, m."""
    one = task_stage.single(stage, drawings)
    spacing = level.Spacing(stage.robots, stage.obstacles, *radii)
    drawn = [judge.draw_level(one, spacing, seed, each, drawings) for each in numbers]
    return Level(*(np.stack(fields) for fields in zip(*drawn, strict=True)))


def split(levels: Level) -> list[Level]:
    """Splits stacked levels [E] into a list of single levels."""
    return [Level(*each) for each in zip(*levels, strict=True)]


def _check_digest(cell: Cell, expected: str, where: str) -> None:
    if cell.digest != expected:
        raise ConfigError(
            f"cell {cell.name} of {where} has the digest {cell.digest[:12]}..., but "
            f"{expected[:12]}... is recorded: the levels differ."
        )


def _arrays(cell: Cell) -> dict[str, np.ndarray]:
    return {"episode": cell.episodes, **cell.levels._asdict()}


# --- files


def write(path: Path, suite: Suite) -> None:
    """Writes levels for other tools, completely or not at all; docs/evaluation.md lists the fields.

    Args:
      path: Path of the .npz file.
      suite: The levels.

    Raises:
      ConfigError: The file cannot be written.
    """
    arrays = {f"{c.name}/{name}": x for c in suite.cells for name, x in _arrays(c).items()}
    keys = ("name", "realism", "seed", "digest", "steps", "hull_friction")
    about = [
        {"stage": to_dict(cell.stage), "levels": len(cell.episodes)}
        | {key: getattr(cell, key) for key in keys}
        for cell in suite.cells
    ]
    meta = json.dumps({"format": FORMAT, "suite": suite.name, "cells": about})
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **{"meta": np.array(meta), **arrays})
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror or error}.") from None


def read(path: Path) -> Suite:
    """Reads levels that `write` or another tool has written, and checks all of them.

    Args:
      path: Path of the .npz file.

    Returns:
      The suite.

    Raises:
      ConfigError: The file is unsound.
    """
    check_text("suite", str(path))
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is not a plain file")  # reading a pipe would wait for its writer
        with path.open("rb") as file:
            arrays = policy.unpack(file)
    except Exception as error:  # zipfile and NumPy raise many types of errors for a damaged file
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise ConfigError(f"suite {path} cannot be read: {reason.rstrip('.')}.") from None
    try:
        return _parse(arrays)
    except ConfigError as error:
        raise ConfigError(f"suite {path}: {error}") from None


def _parse(arrays: dict[str, np.ndarray]) -> Suite:
    try:
        meta = reading.parse_json(str(arrays.pop("meta", None)), "meta")
    except ConfigError:
        meta = None
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise ConfigError(f"meta.format is not {FORMAT}: this version cannot read the suite.")
    file = build(SuiteFileConfig, {"name": meta.get("suite"), "cells": meta.get("cells")}, "meta.")
    suite = Suite(file.name, tuple(_parse_cell(cell, arrays) for cell in file.cells))
    if arrays:
        raise ConfigError(f"{sorted(arrays)[0]} is unknown: meta.cells lists no such cell.")
    return suite


def _parse_cell(cell: CellConfig, arrays: dict[str, np.ndarray]) -> Cell:
    """Takes a cell's arrays from the file's arrays."""
    name, count, robots = cell.name, cell.levels, cell.stage.robots
    boxes = arrays.get(f"{name}/obstacle")
    obstacles = boxes.shape[1] if boxes is not None and boxes.ndim == 3 else 0
    expected = {
        "episode": (np.int64, (count,)),
        "side": (np.float32, (count,)),
        "present": (np.bool_, (count, robots)),
        "start": (np.float32, (count, robots, 3)),
        "target": (np.float32, (count, robots, 2)),
        "obstacle_present": (np.bool_, (count, obstacles)),
        "obstacle": (np.float32, (count, obstacles, 5)),
        "seed": (np.uint32, (count,)),
    }
    fields = {key: _take(arrays, f"{name}/{key}", *form) for key, form in expected.items()}
    episodes, levels = fields.pop("episode"), Level(**fields)
    _check_levels(name, levels, cell.stage)
    read = _cell(cell, episodes, levels)
    if cell.digest is None:
        raise ConfigError(f"cell {name}: digest is missing.")
    _check_digest(read, cell.digest, "the file")
    return read


def _take(
    arrays: dict[str, np.ndarray], name: str, dtype: type, shape: tuple[int, ...]
) -> np.ndarray:
    """Takes one array from a file's arrays, and checks its type and shape."""
    if name not in arrays:
        raise ConfigError(f"{name} is missing.")
    array = arrays.pop(name)
    if array.dtype != dtype or array.shape != shape:
        raise ConfigError(
            f"{name} is {array.dtype} {list(array.shape)}: expected {np.dtype(dtype)} "
            f"{list(shape)}."
        )
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} holds numbers that are not finite.")
    return array


def _check_levels(name: str, levels: Level, stage: StageConfig) -> None:
    """Refuses levels that are impossible in any arena."""
    half = 0.5 * levels.side[:, None, None]
    low, high = (np.float32(end) for end in stage.sides)
    place, boxes = np.abs(levels.obstacle[..., :2]), levels.obstacle[..., 3:]
    beyond = half + np.hypot(boxes[..., :1], boxes[..., 1:])  # for the circle around a box
    rules = {
        f"side is outside {show(stage.sides)} m": (levels.side < low) | (levels.side > high),
        "present is not all true": ~levels.present,
        "start lies outside the walls": np.abs(levels.start[..., :2]) > half,
        "target lies outside the walls": np.abs(levels.target) > half,
        "obstacle has half edges of 0 or less": boxes <= 0.0,
        "obstacle lies outside the walls": levels.obstacle_present[..., None] & (place > half),
        "obstacle is longer than the largest arena": boxes > _LARGEST_HALF,
        "obstacle is not present, but stands inside the walls": ~levels.obstacle_present
        & (place < beyond).all(axis=-1),
    }
    for what, broken in rules.items():
        if broken.any():
            raise ConfigError(f"cell {name}: {what}.")
