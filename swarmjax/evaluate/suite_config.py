"""Suite files: each cell is a set of levels on which policies are judged."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from swarmjax.config import ConfigError, Section, about, build, files, reading, setting, show
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate.config import MOST_STEPS
from swarmjax.task import stage_files
from swarmjax.task.stage_config import StageConfig, complete

# Seeds of a suite's levels begin here. People and benchmarks choose small seeds, so they draw other
# levels. Training uses another generator, JAX's.
SUITE_SEED = 1_000_000


@dataclass(frozen=True, kw_only=True)
class CellConfig(Section):
    """Levels of one kind in a suite."""

    name: str = field(metadata=about("name of the cell"))
    stage: StageConfig
    levels: int = setting(1000, "number of levels", 1, 1_000_000)
    seed: int = field(metadata=about("seed of the levels", SUITE_SEED, MAX_COUNT))
    episodes: tuple[int, ...] = setting(
        (), "indices of the levels; empty: 0 to levels - 1", 0, MAX_COUNT
    )
    realism: Literal["ideal", "webots", "real"] | None = setting(
        None, "realism preset; null: as set for the command"
    )
    steps: int | None = setting(
        None, "control steps of an episode; null: as set for the command", 1, MOST_STEPS
    )
    digest: str | None = setting(None, "SHA-256 of the levels; null: not checked")

    def _check(self) -> None:
        if not re.fullmatch(r"[\w-]+", self.name):
            raise ConfigError(f"name is {show(self.name)}: give letters, digits, _ and - only.")
        if self.episodes and len(self.episodes) != self.levels:
            raise ConfigError(
                f"levels is {self.levels}, but episodes has {len(self.episodes)} entries: list one "
                "episode for each level."
            )


@dataclass(frozen=True, kw_only=True)
class SuiteFileConfig(Section):
    """A suite: levels to evaluate policies on, never to train on."""

    name: str = field(metadata=about("name of the suite, equal to the name of its file"))
    cells: tuple[CellConfig, ...]

    def _check(self) -> None:
        names = [cell.name for cell in self.cells]
        if not names:
            raise ConfigError("cells is []: give at least one cell.")
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"cells lists {name} more than once: give each name once.")


def read_suite(choice: str) -> SuiteFileConfig:
    """Reads the file of a suite.

    Args:
      choice: A name in configs/suites/, or the path of a .yaml file.

    Raises:
      ConfigError: There is no such file, or it is invalid.
    """
    path = files.named_path("suites", choice, "suite")
    mapping = reading.read_yaml(path)
    cells = mapping.get("cells")
    if isinstance(cells, list):
        mapping = mapping | {"cells": [_cell(cell, path.parent) for cell in cells]}
    try:
        return build(SuiteFileConfig, {"name": path.stem} | mapping)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _cell(cell: Any, folder: Path) -> Any:
    """Fills in the stage that a cell names; its file may lie beside the suite's."""
    stage = cell.get("stage") if isinstance(cell, Mapping) else None
    if isinstance(stage, str):
        stage = files.beside(folder, stage)
        return {**cell, "stage": stage_files.read_stage(stage)}
    if isinstance(stage, Mapping):
        return {**cell, "stage": complete({"name": cell.get("name"), **stage})}
    return cell
