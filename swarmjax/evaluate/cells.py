"""Cells: sets of levels to evaluate policies on, drawn from a seed or read from a file.

A suite is a list of cells. A cell may have a digest of its levels. Whoever draws the
levels can compare digests to check that every bit is the same. Levels of a suite are drawn for the
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
    """

    name: str
    stage: StageConfig
    realism: str | None
    seed: int
    episodes: np.ndarray
    levels: Level
    steps: int | None = None

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
      ConfigError: The suite is invalid, or made for smaller robots or other targets.
    """
    if config.suite is None:
        return Suite(None, (draw_stage(config, range(config.episodes)),))
    if config.robot.hull_radius > epuck.HULL_RADIUS:
        raise ConfigError(
            f"robot.hull_radius is {show(config.robot.hull_radius)}, but the levels of suites are "
            f"made for hulls of at most {epuck.HULL_RADIUS} m: give at most {epuck.HULL_RADIUS}."
        )
    if config.task.target_radius != _TARGET_RADIUS:
        raise ConfigError(
            f"task.target_radius is {show(config.task.target_radius)}, but the levels of suites "
            f"are made for {_TARGET_RADIUS} m: give {_TARGET_RADIUS}."
        )
    if Path(config.suite).suffix == ".npz":
        return read(Path(config.suite))
    return draw(config.suite)


def draw(choice: str) -> Suite:
    """Draws the levels of a suite and checks the digests in its file.

    Args:
      choice: A name of configs/suites/, or the path of a .yaml file.

    Returns:
      The suite.

    Raises:
      ConfigError: The file is invalid, or a digest is wrong.
    """
    file = read_suite(choice)
    return Suite(file.name, tuple(map(draw_cell, file.cells)))


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
    """Draws the levels of a suite's cell.

    Raises:
      ConfigError: The cell has another digest.
    """
    numbers, radii = cell.episodes or range(cell.levels), (epuck.HULL_RADIUS, _TARGET_RADIUS)
    levels = _draw(cell.stage, cell.seed, numbers, radii)
    return _cell(cell, np.array(numbers), levels)


def _cell(settings: CellConfig, episodes: np.ndarray, levels: Level) -> Cell:
    """Makes a cell, and checks its digest if its settings have one."""
    about = (settings.name, settings.stage, settings.realism, settings.seed)
    cell = Cell(*about, episodes, levels, settings.steps)
    if settings.digest not in (None, cell.digest):
        raise ConfigError(
            f"the levels of cell {cell.name} have the digest {cell.digest[:12]}..., but the suite "
            f"records {settings.digest[:12]}...: the levels have changed."
        )
    return cell


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


def _arrays(cell: Cell) -> dict[str, np.ndarray]:
    return {"episode": cell.episodes, **cell.levels._asdict()}


# --- files


def write(path: Path, suite: Suite) -> None:
    """Writes the levels of a suite to a file; docs/evaluation.md lists the fields.

    Args:
      path: Path of the .npz file.
      suite: The levels.

    Raises:
      ConfigError: The file cannot be written.
    """
    arrays = {f"{c.name}/{name}": x for c in suite.cells for name, x in _arrays(c).items()}
    keys = ("name", "realism", "seed", "digest", "steps")
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
    """Reads levels that `write` has written.

    Args:
      path: Path of the .npz file.

    Returns:
      The suite.

    Raises:
      ConfigError: The file is invalid.
    """
    check_text("suite", str(path))
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is not a regular file")  # reading a pipe would wait for its writer
        with path.open("rb") as file:
            arrays = policy.unpack(file)
        return _parse(arrays)
    except Exception as error:  # zipfile and NumPy raise many types of errors for a damaged file
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise ConfigError(f"suite {path} cannot be read: {reason.rstrip('.')}.") from None


def _parse(arrays: dict[str, np.ndarray]) -> Suite:
    meta = reading.parse_json(str(arrays.get("meta")), "meta")
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise ConfigError(f"meta.format is not {FORMAT}")
    file = build(SuiteFileConfig, {"name": meta.get("suite"), "cells": meta.get("cells")}, "meta.")
    return Suite(file.name, tuple(_parse_cell(cell, arrays) for cell in file.cells))


def _parse_cell(cell: CellConfig, arrays: dict[str, np.ndarray]) -> Cell:
    """Takes a cell's arrays from the file's arrays, and checks their types and shapes."""
    count, robots = cell.levels, cell.stage.robots
    boxes = arrays.get(f"{cell.name}/obstacle", np.empty(0))
    obstacles = boxes.shape[1] if boxes.ndim == 3 else 0
    forms = {
        "episode": (np.int64, (count,)),
        "side": (np.float32, (count,)),
        "present": (np.bool_, (count, robots)),
        "start": (np.float32, (count, robots, 3)),
        "target": (np.float32, (count, robots, 2)),
        "obstacle_present": (np.bool_, (count, obstacles)),
        "obstacle": (np.float32, (count, obstacles, 5)),
        "seed": (np.uint32, (count,)),
    }
    fields = {key: arrays.get(f"{cell.name}/{key}", np.empty(0)) for key in forms}
    for key, (dtype, shape) in forms.items():
        array = fields[key]
        if array.dtype != dtype or array.shape != shape or not np.isfinite(array).all():
            raise ConfigError(f"{cell.name}/{key} is not finite {dtype.__name__} {list(shape)}")
    return _cell(cell, fields.pop("episode"), Level(**fields))
