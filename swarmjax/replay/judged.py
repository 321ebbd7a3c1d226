"""Finds results that `evaluate` has stored, so that a replay need not evaluate a policy again."""

import csv
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.config import reading
from swarmjax.evaluate import summary
from swarmjax.evaluate.cells import Suite
from swarmjax.evaluate.trials import Entrant, Trial
from swarmjax.replay.config import ReplayConfig

RANKED = ("targets_reached", "contacts_per_robot", "episode_time_s")  # they rank episodes


def find(settings: ReplayConfig, entrant: Entrant, suite: Suite) -> tuple[str, list[Trial]] | None:
    """Looks for a policy's results in the files of an evaluation.

    Looks in the folder of the policy file and in the folder of the page, and in their subfolders
    one level down.

    Args:
      settings: The replay's settings.
      entrant: The policy.
      suite: The levels.

    Returns:
      The folder of the files, and trials with the measures `RANKED` alone. None if no file has the
      same policy, levels, settings and versions of the software. Also None if the settings name an
      extension, because its code may have changed since the evaluation.
    """
    config = settings.evaluation
    cells = [summary.about_cell(config, cell) for cell in suite.cells]
    # Tuples become lists, as in a file.
    wanted = json.loads(json.dumps({**summary.about(config, suite.name), "cells": cells}))
    places = dict.fromkeys(Path(path).parent for path in (entrant.path, settings.out))
    names = () if settings.extensions else ("result.json", "*/result.json")
    for file in (file for place in places for name in names for file in sorted(place.glob(name))):
        # A file of something else, or a damaged one, may raise any of these.
        with suppress(AttributeError, LookupError, TypeError, ValueError, csv.Error):
            path = _match(reading.read_json(file), wanted, entrant.policy.digest)
            return reading.called(file.parent), _read(file.with_name("levels.csv"), path, suite)
    return None


def _match(result: Any, wanted: dict[str, Any], digest: str) -> str:
    """Returns the path under which a result lists the policy.

    Raises an error if the result is of another evaluation or of other policies.
    """
    stored = {key: result[key] for key in wanted}
    stored["cells"] = [{key: cell[key] for key in wanted["cells"][0]} for cell in result["cells"]]
    if stored != wanted:
        raise ValueError("it is another evaluation")
    sides = result.get("compared") or [result["policies"]]
    return {each["digest"]: each["path"] for side in sides for each in side}[digest]


def _read(file: Path, path: str, suite: Suite) -> list[Trial]:
    """Reads a policy's rows.

    Raises an error unless there is one row for each level of the suite, in the suite's order.
    """
    rows = csv.DictReader(line.decode() for line in reading.read_lines(file))
    mine = [row for row in rows if row["policy"] == path]
    levels = [(cell.name, str(number)) for cell in suite.cells for number in cell.episodes]
    if [(row["cell"], row["episode"]) for row in mine] != levels:
        raise ValueError("it has other levels")
    trials, unread = [], iter(mine)
    for cell in suite.cells:
        part = [next(unread) for _ in cell.episodes]
        measured = {name: np.array([[float(row[name]) for row in part]]) for name in RANKED}
        trials.append(Trial(cell, np.empty(0), measured))
    return trials
