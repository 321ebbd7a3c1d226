"""Expands a grid of settings, such as `grid.algo.epochs=1,2`, into runs."""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from swarmjax.config import ConfigError, files, reading, show
from swarmjax.run.directory import SUMMARY
from swarmjax.run.load_settings import load_run
from swarmjax.run.settings import TrainConfig

GRID = "grid."
MOST_CELLS = 256
# Keys that this module sets for each cell.
_OWN = ("resume", "run.dir", "run.distributed", "run.dry")


@dataclass(frozen=True, kw_only=True)
class GridCell:
    """One combination of a grid's values.

    Attributes:
      label: the values of the combination, as words.
      run: its run directory.
      words: words of the command line of `swarmjax.train` that begin or continue this run.
      settings: the config that these words give.
    """

    label: str
    run: Path
    words: tuple[str, ...]
    settings: TrainConfig

    @property
    def is_done(self) -> bool:
        """Whether the cell's run has spent its budget."""
        path = self.run / SUMMARY
        found = reading.read_json(path) if path.exists() else None
        if not isinstance(found, dict):
            return False
        return found.get("budget_spent") is True and found.get("updates") == self.settings.updates


def multiply(folder: Path, typed: Sequence[str]) -> list[GridCell]:
    """Expands a grid into its cells.

    Args:
      folder: the folder for the run directories.
      typed: words `grid.KEY=VALUE,VALUE`, and words `KEY=VALUE` that all cells share.

    Returns:
      The cells. The values of the last key vary fastest.

    Raises:
      ConfigError: if a word or a cell is invalid, or if there are no cells or too many.
    """
    grid: dict[str, list[str]] = {}
    shared = []
    for word in typed:
        key, equals, value = word.partition("=")
        if not equals:
            raise ConfigError(f"{show(word)} is not a setting: give key=value.")
        if key.removeprefix(GRID) in _OWN:
            raise ConfigError(f"{key} cannot be given: each cell of the grid has its own.")
        _check_once(key, {*grid, *(each.partition("=")[0] for each in shared)})
        if key.startswith(GRID):
            grid[key.removeprefix(GRID)] = _values(key.removeprefix(GRID), value)
        else:
            shared.append(word)
    if not grid:
        raise ConfigError(f"the grid is empty: give values, as in {GRID}algo.epochs=1,2.")
    if math.prod(map(len, grid.values())) > MOST_CELLS:
        raise ConfigError(f"the grid has more than {MOST_CELLS} cells: give fewer values.")
    return _cells(folder, grid, shared)


def _check_once(key: str, given: set[str]) -> None:
    """Refuses a key that an earlier word has given."""
    if key.removeprefix(GRID) in given:
        raise ConfigError(f"{key.removeprefix(GRID)} is given twice: give each key once.")


def _values(key: str, text: str) -> list[str]:
    """Splits the values of a key, which are a list in YAML: `1,2` or `[1,2],[3]`."""
    found = reading.parse_yaml(f"[{text}]", f"{GRID}{key} is {show(text)}, which cannot be read: ")
    words = [each if isinstance(each, str) else files.write(each) for each in found or [""]]
    files.parse(TrainConfig, [f"{key}={word}" for word in words])
    return words


def _cells(folder: Path, grid: dict[str, list[str]], shared: Sequence[str]) -> list[GridCell]:
    """Loads the settings of each combination."""
    cells: dict[Path, GridCell] = {}
    for values in itertools.product(*grid.values()):
        mine = [f"{key}={value}" for key, value in zip(grid, values, strict=True)]
        run = folder / re.sub(r"[^\w.=+-]+", "-", re.sub(r"[][{}'\"]", "", "_".join(mine)))
        if run in cells:
            raise ConfigError(f"two cells of the grid would be {run}: give values that differ.")
        words = (*shared, *mine, "resume=auto", f"run.dir={run}")
        settings = load_run(words)
        cells[run] = GridCell(label=" ".join(mine), run=run, words=words, settings=settings)
    return list(cells.values())
