"""Reads the files of a reproduction of the paper back as arrays for its report. No JAX.

Axes: N seeds, E episodes of a seed, R robots (most of any episode). An arm is one way to train. An
unfinished arm is left out, and the report names each figure that lacks it. If a finished arm lacks
an episode log, a seed or its evaluation, an error names the file and the arm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.evaluate.statistics import LEAST_DRAWN
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import Row, ValueKind
from swarmjax.run.recorder import EPISODES

FACTS, EVALUATION = "reproduce.json", "evaluation.json"
FORMAT = 2  # of both files
LAST, EXPANDED = "paper6", "paper_expanded"  # the stages that policies are judged on
ARMS = {
    "curriculum": "the paper's algorithm with its curriculum",
    "baseline": "the paper's algorithm on the last stage from scratch",
    "curriculum_expanded": "curriculum, trained on at 1.5 m",
    "baseline_expanded": "baseline, trained on at 1.5 m",
    "modern_curriculum": "the default trainer with the paper's curriculum",
    "modern_baseline": "the default trainer on the last stage from scratch",
}
PAIR = ("curriculum", "baseline")
TUNED = ("curriculum_expanded", "baseline_expanded")
MODERN = ("modern_curriculum", "modern_baseline")
# Keys of a row of the evaluation. Each is measured over the row's episodes.
JUDGED = ("targets_reached", "all_reached", "sensed_share", "contacts_per_robot", "return")
_COUNTS = ("seed", "update", "arena_steps", "steps", "robots")
_BY_ROBOT = {
    "reached": report_rows.FLAG,
    "reward": report_rows.NUMBER,
    **dict.fromkeys(("robot_steps", "sensed", "contacts"), report_rows.COUNT),
}
_SEEDS = ValueKind(
    "list of whole numbers",
    lambda value: isinstance(value, list) and all(map(report_rows.COUNT.fits, value)),
)
_MAPS = ("settings", "versions", "device", "commit", "seconds", "compile_s")


@dataclass(frozen=True, kw_only=True, eq=False)
class RunLog:
    """Episodes of one seed, in the order in which they ended.

    For an absent robot `reached` is False and all values below it are 0.

    Attributes:
      number: [E] number of the episode in its run, from 1, increasing.
      arena_steps: [E] control steps over all arenas of the seed when the episode ended.
      stage: [E] name of the stage.
      present: [E, R] whether the robot was present.
      reached: [E, R] whether the robot reached its target.
      reward: [E, R] sum over the episode, undiscounted, m.
      robot_steps: [E, R] control steps before the robot arrived.
      sensed: [E, R] how many of `robot_steps` had something in infrared range: the paper's
        collisions.
      contacts: [E, R] contacts that the robot began or met.
    """

    number: np.ndarray
    arena_steps: np.ndarray
    stage: np.ndarray
    present: np.ndarray
    reached: np.ndarray
    reward: np.ndarray
    robot_steps: np.ndarray
    sensed: np.ndarray
    contacts: np.ndarray

    def __len__(self) -> int:
        return len(self.number)

    def on(self, stage: str | None) -> "RunLog":
        """Selects the episodes of one stage, with their numbers in the whole run; None for all."""
        return self if stage is None else self.where(self.stage == stage)

    def where(self, chosen: np.ndarray) -> "RunLog":
        """Selects the episodes of a mask [E]."""
        return RunLog(**{name: values[chosen] for name, values in vars(self).items()})


@dataclass(frozen=True, kw_only=True, eq=False)
class Reproduction:
    """The results of a reproduction.

    Attributes:
      facts: contents of `reproduce.json`.
      seeds: [N], increasing.
      logs: N logs of each finished arm.
      judged: [N] values by finished arm and stage, for each name in `JUDGED`.
    """

    facts: Row
    seeds: tuple[int, ...]
    logs: dict[str, tuple[RunLog, ...]]
    judged: dict[tuple[str, str], dict[str, np.ndarray]]

    def lacking(self, arms: Sequence[str]) -> list[str]:
        """Lists which of the given arms have not finished."""
        return [arm for arm in arms if arm not in self.logs]


def read(out: Path) -> Reproduction:
    """Reads the directory of a reproduction.

    Raises:
      ConfigError: if a file, a finished arm, a seed or an evaluation is missing or damaged.
    """
    facts = _read_facts(out)
    seeds = tuple(sorted(facts["seeds"]))
    finished = [arm for arm in ARMS if arm in facts["seconds"]]
    if not finished:
        raise ConfigError(f"{out / FACTS} names no finished arm: continue the reproduction.")
    return Reproduction(
        facts=facts,
        seeds=seeds,
        logs={arm: _read_logs(out / arm, seeds) for arm in finished},
        judged=_read_judged(out, finished, seeds),
    )


def _read_facts(out: Path) -> Row:
    """Reads `reproduce.json`, the facts of the reproduction."""
    path = out / FACTS
    if not path.exists():
        raise ConfigError(f"{out} is not a reproduction: it has no {FACTS}.")
    facts = report_rows.read_object(path)
    _check_format(facts, path)
    report_rows.check(facts, ("budget", "fine_tune"), report_rows.WHOLE, str(path))
    report_rows.check(facts, ("seeds",), _SEEDS, str(path))
    seeds = facts["seeds"]
    if len(set(seeds)) < LEAST_DRAWN:
        raise ConfigError(
            f"{path} has {len(set(seeds))} seeds: an interval needs {LEAST_DRAWN} or more."
        )
    report_rows.check(facts, _MAPS, report_rows.MAP, str(path))
    for key in ("seconds", "compile_s"):
        number = report_rows.NUMBER_OR_NULL
        report_rows.check(facts[key], facts[key], number, f"{path}, {key},")
    return facts


def _check_format(found: Row, path: Path) -> None:
    if found.get("format") != FORMAT:
        raise ConfigError(
            f"{path} has format {found.get('format')!r}, but only format {FORMAT} is supported."
        )


def _read_logs(run: Path, seeds: Sequence[int]) -> tuple[RunLog, ...]:
    """Reads the episodes of an arm, by seed."""
    if not (run / EPISODES).exists():
        raise ConfigError(f"{run} has no {EPISODES}, although its arm has finished.")
    by_seed: dict[int, list[Row]] = {seed: [] for seed in seeds}
    for where, row in report_rows.read_lines(run, EPISODES):
        _check_episode(row, where)
        if row["seed"] not in by_seed:
            raise ConfigError(f"{where} has seed {row['seed']}, which is not in {FACTS}.")
        rows = by_seed[row["seed"]]
        if rows and row["update"] < rows[-1]["update"]:
            raise ConfigError(f"{where} goes back to update {row['update']}: it is damaged.")
        rows.append(row)
    for seed, rows in by_seed.items():
        if not rows:
            raise ConfigError(f"{run / EPISODES} has no episode of seed {seed}.")
    return tuple(_log(by_seed[seed]) for seed in seeds)


def _check_episode(row: Row, where: str) -> None:
    """Checks that an episode has all its values and that its lists have the right length."""
    report_rows.check(row, _COUNTS, report_rows.WHOLE, where)
    report_rows.check(row, ("stage",), report_rows.NAME, where)
    for key, kind in _BY_ROBOT.items():
        found: Any = row.get(key)
        fits = isinstance(found, list) and len(found) == row["robots"] > 0
        if not fits or not all(map(kind.fits, found)):
            raise ConfigError(f"{where} has {key}, which is not a list of {row['robots']} values.")


def _log(rows: list[Row]) -> RunLog:
    """Arranges the episodes of a seed in arrays, sorted by the arena steps when they ended."""
    rows = sorted(rows, key=lambda row: row["arena_steps"])
    robots = np.array([row["robots"] for row in rows])
    present = np.arange(robots.max()) < robots[:, None]
    columns: dict[str, np.ndarray] = {}
    for key in _BY_ROBOT:
        flat = np.concatenate([row[key] for row in rows])
        columns[key] = np.zeros(present.shape, flat.dtype)
        columns[key][present] = flat
    return RunLog(
        number=np.arange(1, len(rows) + 1),
        arena_steps=np.array([row["arena_steps"] for row in rows]),
        stage=np.array([row["stage"] for row in rows]),
        present=present,
        **columns,
    )


def _read_judged(
    out: Path, arms: Sequence[str], seeds: Sequence[int]
) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    """Reads the results of the final policies of finished arms."""
    path = out / EVALUATION
    if not path.exists():
        raise ConfigError(f"{out} has no {EVALUATION}: its policies are not judged yet.")
    found = report_rows.read_object(path)
    _check_format(found, path)
    rows: dict[tuple[str, str, int], Row] = {}
    if not isinstance(found.get("rows"), list):
        raise ConfigError(f"{path} has no list of rows: it is damaged.")
    for number, row in enumerate(found["rows"], 1):
        _check_judged(row, f"{path}, row {number},")
        rows[row["arm"], row["stage"], row["seed"]] = row
    judged = {}
    for arm, stage in ((arm, stage) for arm in arms for stage in (LAST, EXPANDED)):
        for seed in seeds:
            if (arm, stage, seed) not in rows:
                raise ConfigError(f"{path} has no row of arm {arm}, seed {seed} on {stage}.")
        of_arm = [rows[arm, stage, seed] for seed in seeds]
        judged[arm, stage] = {key: np.array([row[key] for row in of_arm]) for key in JUDGED}
    return judged


def _check_judged(row: Any, where: str) -> None:
    """Checks that a row of the evaluation has all its values."""
    if not report_rows.MAP.fits(row):
        raise ConfigError(f"{where} holds no keys and values: it is damaged.")
    report_rows.check(row, ("seed", "episodes"), report_rows.WHOLE, where)
    report_rows.check(row, ("arm", "stage"), report_rows.NAME, where)
    report_rows.check(row, JUDGED, report_rows.NUMBER, where)
