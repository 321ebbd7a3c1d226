"""Keeps an evaluation's finished cells, one file for each, until the result is written.

The files lie in a folder inside the result's folder, with `evaluation.json`, which describes the
evaluation. The same command resumes from them. Another command is refused, so that a slip does not
lose hours of work.
"""

import contextlib
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax import outputs, provenance
from swarmjax.config import ConfigError, reading, to_dict
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.trials import Entrant, Trial, specialise
from swarmjax.outputs import replacing

_NAME = "unfinished"
ABOUT = "evaluation.json"
# Keys for places of files and numbers of processes, which change no figure. For files that matter,
# digests are compared.
_ELSEWHERE = ("policy", "compare", "suite", "out", "workers", "extensions")


def place(out: Path) -> Path:
    """Returns the folder for a result's finished cells.

    Args:
      out: Folder of the result, or its .json file.
    """
    return out.with_name(f"{out.name}.{_NAME}") if out.suffix == ".json" else out / _NAME


def about(
    config: EvaluateConfig, cells: Sequence[Cell], entrants: Sequence[Entrant]
) -> dict[str, Any]:
    """Describes an evaluation: everything that its figures depend on.

    Args:
      config: Settings of the evaluation.
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
    return json.loads(json.dumps(found))  # the same types as when read from the file


def _digest(path: Path) -> str:
    return hashlib.sha256(reading.read_bytes(path)).hexdigest()


def read(folder: Path, judged: Mapping[str, Any], cells: Sequence[Cell]) -> dict[int, Trial]:
    """Reads the finished cells.

    Args:
      folder: Result of `place`; it need not exist.
      judged: Result of `about`.
      cells: Cells of the evaluation.

    Returns:
      The policies' results, by the row of their cell.

    Raises:
      ConfigError: The saved cells belong to another evaluation, or cannot be read.
    """
    paths = {row: _path(folder, row) for row in range(len(cells))}
    paths = {row: path for row, path in paths.items() if path.exists()}
    if not paths:
        return {}
    before = reading.parse_json(reading.read_text(folder / ABOUT), str(folder / ABOUT))
    key = _first_difference(before, judged)
    if key is not None:
        raise ConfigError(
            f"out has {folder}, from an unfinished evaluation that differs from this one in "
            f"{key}: repeat its command, give another out, or remove that folder."
        )
    return {row: _read_trial(path, cells[row]) for row, path in paths.items()}


def write(folder: Path, judged: Mapping[str, Any], row: int, trial: Trial) -> None:
    """Writes a finished cell, completely or not at all.

    Args:
      folder: Result of `place`; it is made if it is missing.
      judged: Result of `about`.
      row: Row of the cell.
      trial: The policies' results on it.

    Raises:
      ConfigError: The files cannot be written.
    """
    arrays = {"shortest": trial.shortest, "arrival": trial.arrival}
    arrays |= {f"found/{name}": table for name, table in trial.found.items()}
    try:
        with replacing(folder / ABOUT) as temporary:
            temporary.write_text(json.dumps(judged, indent=2) + "\n")
        outputs.note([folder / ABOUT])
        with replacing(_path(folder, row)) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error.strerror or error}.") from None


def remove(folder: Path) -> None:
    """Removes the saved cells, and the folder if it holds nothing else."""
    with contextlib.suppress(OSError):
        for path in [*_cells(folder), folder / ABOUT, folder / outputs.NOTES]:
            path.unlink(missing_ok=True)
        folder.rmdir()


def count(folder: Path) -> int:
    """Counts the saved cells."""
    return len(_cells(folder))


def _cells(folder: Path) -> list[Path]:
    return [path for path in folder.glob("cell*.npz") if re.fullmatch(r"cell\d+", path.stem)]


def _path(folder: Path, row: int) -> Path:
    return folder / f"cell{row}.npz"


def _read_trial(path: Path, cell: Cell) -> Trial:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        shortest, arrival = arrays.pop("shortest"), arrays.pop("arrival")
    except Exception as error:  # zipfile and NumPy raise many types of errors for a damaged file
        raise ConfigError(
            f"{path} cannot be read: {str(error).rstrip('.')}. Remove the file, and its cell will "
            "be judged again."
        ) from None
    found = {name.removeprefix("found/"): table for name, table in arrays.items()}
    return Trial(cell, shortest, found, arrival)


def _first_difference(one: Any, other: Any, key: str = "") -> str | None:
    """Names the first key at which two pieces of plain data differ; None if they are equal."""
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        return None if one == other else key
    for name in dict.fromkeys([*one, *other]):
        if (name in one) != (name in other):
            return f"{key}.{name}".lstrip(".")
        found = _first_difference(one[name], other[name], f"{key}.{name}".lstrip("."))
        if found is not None:
            return found
    return None
