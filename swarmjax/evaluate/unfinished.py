"""What an evaluation has found so far, a file for each cell, kept until its result is written.

The files lie in a folder in that of the result, with `evaluation.json`, which says what is judged.
The same command goes on from them; another one is refused, so that no hours are lost by a slip.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax import provenance
from swarmjax.atomic_file import replacing
from swarmjax.config import ConfigError, reading, to_dict
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.trials import Entrant, Trial, specialise

_NAME = "unfinished"
_ABOUT = "evaluation.json"
# Keys that say where files are and how many processes work, which changes no figure. Of files that
# count, digests are compared.
_ELSEWHERE = ("policy", "compare", "suite", "out", "workers", "extensions")


def place(out: Path) -> Path:
    """Says where what is unfinished of a result lies.

    Args:
        out: Folder of the result, or its file .json.
    """
    return out.with_name(f"{out.name}.{_NAME}") if out.suffix == ".json" else out / _NAME


def about(
    config: EvaluateConfig, cells: Sequence[Cell], entrants: Sequence[Entrant]
) -> dict[str, Any]:
    """Says what is judged: all that the figures of an evaluation depend on.

    Args:
        config: Of the evaluation.
        cells: Its levels.
        entrants: The policies, in their order.

    Returns:
        Plain data for JSON.
    """
    code = None if config.extensions is None else _digest(Path(config.extensions))
    found = {
        "versions": {**provenance.versions(), "commit": provenance.commit()},
        "policies": [each.policy.digest for each in entrants],
        "extensions": code,
        "cells": {
            cell.name: {
                "levels": cell.digest,
                **{
                    key: value
                    for key, value in to_dict(specialise(config, cell)).items()
                    if key not in _ELSEWHERE
                },
            }
            for cell in cells
        },
    }
    return json.loads(json.dumps(found))  # as it comes back from the file


def _digest(path: Path) -> str:
    return hashlib.sha256(reading.read_bytes(path)).hexdigest()


def read(folder: Path, judged: Mapping[str, Any], cells: Sequence[Cell]) -> dict[int, Trial]:
    """Reads the cells that are over.

    Args:
        folder: As `place` names it; it need not be there.
        judged: What is judged, as `about` says it.
        cells: Of the evaluation.

    Returns:
        By their row, what policies came to on cells.

    Raises:
        ConfigError: If they are of another evaluation, or cannot be read.
    """
    paths = {row: _path(folder, row) for row in range(len(cells))}
    paths = {row: path for row, path in paths.items() if path.exists()}
    if not paths:
        return {}
    before = reading.parse_json(reading.read_text(folder / _ABOUT), str(folder / _ABOUT))
    key = _first_difference(before, judged)
    if key is not None:
        raise ConfigError(
            f"out has {folder}, where an evaluation was stopped that differs from this one in "
            f"{key}: give the command that was stopped, give another out, or remove that folder."
        )
    return {row: _read_trial(path, cells[row]) for row, path in paths.items()}


def write(folder: Path, judged: Mapping[str, Any], row: int, trial: Trial) -> None:
    """Writes a cell that is over, whole or not at all.

    Args:
        folder: As `place` names it; it is made if it is missing.
        judged: What is judged, as `about` says it.
        row: Of the cell.
        trial: What policies came to on it.

    Raises:
        ConfigError: If it cannot be written.
    """
    arrays = {"shortest": trial.shortest, "arrival": trial.arrival}
    arrays |= {f"found/{name}": table for name, table in trial.found.items()}
    try:
        with replacing(folder / _ABOUT) as temporary:
            temporary.write_text(json.dumps(judged, indent=2) + "\n")
        with replacing(_path(folder, row)) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error.strerror or error}.") from None


def remove(folder: Path) -> None:
    """Removes what was kept, once the result is written."""
    shutil.rmtree(folder, ignore_errors=True)


def count(folder: Path) -> int:
    """Counts the cells that are kept."""
    return len(list(folder.glob("cell*.npz")))


def _path(folder: Path, row: int) -> Path:
    return folder / f"cell{row}.npz"


def _read_trial(path: Path, cell: Cell) -> Trial:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        shortest, arrival = arrays.pop("shortest"), arrays.pop("arrival")
    except Exception as error:  # whatever a damaged file makes zipfile and NumPy raise
        raise ConfigError(
            f"{path} cannot be read: {str(error).rstrip('.')}. Remove it; its cell is judged again."
        ) from None
    found = {name.removeprefix("found/"): table for name, table in arrays.items()}
    return Trial(cell, shortest, found, arrival)


def _first_difference(one: Any, other: Any, key: str = "") -> str | None:
    """Names the first key in which plain data differ; None if there is none."""
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        return None if one == other else key
    for name in dict.fromkeys([*one, *other]):
        if (name in one) != (name in other):
            return f"{key}.{name}".lstrip(".")
        found = _first_difference(one[name], other[name], f"{key}.{name}".lstrip("."))
        if found is not None:
            return found
    return None
