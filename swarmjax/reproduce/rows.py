"""Reads the files of a reproduction of the paper into arrays, for the report. Needs no JAX.

Axes: N seeds, E episodes of a seed, R robots (the largest number in any episode). An arm is one way
to train. An unfinished arm is left out, and the report names the figures in which the arm is
missing. If a finished arm lacks an episode log, a seed or its evaluation, an error names the file
and the arm.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from swarmjax.config import ConfigError, build
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import Row
from swarmjax.reproduce.config import ARMS, ReproduceConfig
from swarmjax.run.directory import SUMMARY, has_ended
from swarmjax.run.recorder import EPISODES

FACTS, EVALUATION = "reproduce.json", "evaluation.json"
FORMAT = 4  # format of both files
_LAST_READER = "8820a9f"  # the last commit that reads format 3
LAST, EXPANDED = "paper6", "paper_expanded"  # stages of the evaluation
Action = Literal["sampled", "mean"]
ACTIONS: tuple[Action, ...] = get_args(Action)
PAIR = ("curriculum", "baseline")
TUNED = ("curriculum_expanded", "baseline_expanded")
MODERN = ("modern_curriculum", "modern_baseline")
# Keys of a row of the evaluation. Each value is measured over all episodes of the row.
JUDGED = ("targets_reached", "all_reached", "sensed_share", "contacts_per_robot")
# The kind of the values with one entry per robot in `episodes.jsonl`.
_BY_ROBOT = {
    "reached": report_rows.FLAG,
    "reward": report_rows.NUMBER,
    **dict.fromkeys(("robot_steps", "sensed", "contacts"), report_rows.COUNT),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class RunLog:
    """Episodes of one seed, in the order in which they ended.

    For an absent robot, `reached` is False and all fields after it are 0.

    Attributes:
      number: [E] number of the episode in its run, from 1, increasing.
      arena_steps: [E] control steps over all arenas of the seed when the episode ended.
      stage: [E] name of the stage.
      present: [E, R] whether the robot was present.
      reached: [E, R] whether the robot reached its target.
      reward: [E, R] undiscounted sum of the robot's rewards over the episode, m.
      robot_steps: [E, R] control steps before the robot arrived.
      sensed: [E, R] how many of the `robot_steps` had something in infrared range. The paper calls
        these steps collisions.
      contacts: [E, R] number of the robot's contacts, whichever side began them.
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
        """Selects the episodes of one stage, with their numbers in the run. None selects all."""
        return self if stage is None else self.where(self.stage == stage)

    def where(self, chosen: np.ndarray) -> "RunLog":
        """Selects the episodes where a mask [E] is True."""
        return RunLog(**{name: values[chosen] for name, values in vars(self).items()})


@dataclass(frozen=True, kw_only=True, eq=False)
class Reproduction:
    """The results of a reproduction.

    Attributes:
      settings: settings of the reproduction.
      versions: versions of the software that computed the results, by name.
      summaries: `summary.json` of each finished arm.
      logs: N logs of each finished arm.
      judged: [N] values by finished arm, stage and kind of action, for each name in `JUDGED`.
    """

    settings: ReproduceConfig
    versions: Row
    summaries: dict[str, Row]
    logs: dict[str, tuple[RunLog, ...]]
    judged: dict[tuple[str, str, Action], dict[str, np.ndarray]]

    @property
    def seeds(self) -> range:
        """The seeds [N]."""
        return range(self.settings.seeds)

    def lacking(self, arms: Sequence[str]) -> list[str]:
        """Lists which of the given arms have not finished."""
        return [arm for arm in arms if arm not in self.logs]


def read(out: Path) -> Reproduction:
    """Reads the directory of a reproduction.

    Raises:
      ConfigError: if a file, a finished arm, a seed or an evaluation is missing or damaged.
    """
    facts = read_facts(out)
    settings = build(ReproduceConfig, facts["settings"], f"{out / FACTS}: settings.")
    finished = summaries(out)
    if not finished:
        raise ConfigError(f"{out} has no finished arm yet: continue it with resume={out}.")
    return Reproduction(
        settings=settings,
        versions=facts["versions"],
        summaries=finished,
        logs={arm: _read_logs(out / arm, range(settings.seeds)) for arm in finished},
        judged=_read_judged(out, list(finished), range(settings.seeds)),
    )


def read_facts(out: Path) -> Row:
    """Reads `reproduce.json`: the settings of the reproduction, and versions of software.

    Raises:
      ConfigError: if the file is missing or damaged, or has another format.
    """
    if not (out / FACTS).exists():
        raise ConfigError(f"{out} is not a reproduction: it has no {FACTS}.")
    facts = _read_object(out / FACTS)
    report_rows.check(facts, ("settings", "versions"), report_rows.MAP, str(out / FACTS))
    return facts


def summaries(out: Path) -> dict[str, Row]:
    """Reads the summaries of the arms that are done.

    Args:
      out: directory of the reproduction.

    Returns:
      The `summary.json` of each arm, in the order of `ARMS`.

    Raises:
      ConfigError: if a file is damaged.
    """
    paths = {arm: out / arm / SUMMARY for arm in ARMS}
    every = {arm: report_rows.read_object(path) for arm, path in paths.items() if path.exists()}
    finished = {arm: summary for arm, summary in every.items() if has_ended(summary)}
    for arm, summary in finished.items():
        times = ("train_s", "compile_s")
        report_rows.check(summary, times, report_rows.NUMBER_OR_NULL, str(paths[arm]))
    return finished


def read_rows(out: Path) -> list[Row]:
    """Reads the rows of `evaluation.json`, or returns no rows if the file does not exist yet.

    There is a row for each policy, stage and kind of action.

    Raises:
      ConfigError: if the file is damaged or has another format.
    """
    path = out / EVALUATION
    if not path.exists():
        return []
    rows = _read_object(path).get("rows")
    if not isinstance(rows, list) or not all(map(report_rows.MAP.fits, rows)):
        raise ConfigError(f"{path} has no list of rows: delete this file to evaluate again.")
    for number, row in enumerate(rows, 1):
        where = f"{path}, row {number},"
        report_rows.check(row, ("seed",), report_rows.COUNT, where)
        report_rows.check(row, ("arm", "stage", "action"), report_rows.NAME, where)
        report_rows.check(row, JUDGED, report_rows.NUMBER, where)
    return rows


def _read_object(path: Path) -> Row:
    """Reads `reproduce.json` or `evaluation.json`, and checks its format."""
    content = report_rows.read_object(path)
    if content.get("format") != FORMAT:
        raise ConfigError(
            f"{path} has format {content.get('format')!r}, but this version reads only format "
            f"{FORMAT}; commit {_LAST_READER} was the last to read format 3."
        )
    return content


def _read_logs(run: Path, seeds: Sequence[int]) -> tuple[RunLog, ...]:
    """Reads the episodes of an arm, by seed."""
    by_seed: dict[int, list[Row]] = {seed: [] for seed in seeds}
    for where, row in report_rows.read_lines(run, EPISODES):
        report_rows.check(row, ("seed", "arena_steps", "robots"), report_rows.COUNT, where)
        report_rows.check(row, ("stage",), report_rows.NAME, where)
        for key, kind in _BY_ROBOT.items():
            report_rows.check(row, (key,), report_rows.list_of(kind, row["robots"]), where)
        if row["seed"] not in by_seed:
            raise ConfigError(f"{where} has seed {row['seed']}, which is not in {FACTS}.")
        by_seed[row["seed"]].append(row)
    for seed, rows in by_seed.items():
        if not rows:
            raise ConfigError(
                f"{run / EPISODES} has no complete episode of seed {seed}: give a larger budget."
            )
    return tuple(_log(by_seed[seed]) for seed in seeds)


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
) -> dict[tuple[str, str, Action], dict[str, np.ndarray]]:
    """Reads the evaluation of the final policies of finished arms, as in `Reproduction.judged`."""
    keys = ("arm", "stage", "action", "seed")
    rows = {tuple(row[key] for key in keys): row for row in read_rows(out)}
    judged = {}
    for arm, stage, action in itertools.product(arms, (LAST, EXPANDED), ACTIONS):
        for seed in seeds:
            if (arm, stage, action, seed) not in rows:
                raise ConfigError(
                    f"{out / EVALUATION} has no row for arm {arm}, seed {seed}, stage {stage} and "
                    f"{action} actions."
                )
        of_arm = [rows[arm, stage, action, seed] for seed in seeds]
        judged[arm, stage, action] = {key: np.array([row[key] for row in of_arm]) for key in JUDGED}
    return judged
