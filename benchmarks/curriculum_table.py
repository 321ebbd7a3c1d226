"""Makes tables and learning curves from the JSON lines of `benchmarks.curriculum`.

`python -m benchmarks.curriculum_table FILE... [measure=all_reached] [out=DIR]` prints a Markdown
table for each goal, kind of policy, number of arenas and budget. With `out` it also draws the
learning curves into DIR, as `<goal>-<policy>-<arenas>-<budget>-<measure>.png`. The measure is the
share of targets reached, or the share of episodes in which all targets were reached.

Every number has the 95 % interval of a stratified bootstrap over seeds
(swarmjax.evaluate.statistics). All numbers except the probabilities are interquartile means over
seeds. The columns are:

- `goal`, `1.5 m`: the final share on the goal, and the final share in the 1.5 m arena, on which no
  arm trained.
- `to 0.8`, `to 0.9`: arena steps until a seed's share on the goal first reaches this value.
- `area`, `area (log)`: mean share on the goal during training. The mean of `area` is over the arena
  steps, and the mean of `area (log)` is over the logarithm of the arena steps.
- `forgotten`: the best share on the first stage at any point, minus the final share on this stage;
  `-` if the first stage was not judged.
- `P(end)`, `P(area)`: the probability that a seed ends with a higher share than a seed of the
  baseline, and the probability that the seed's `area` is larger.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from benchmarks.curriculum_arms import BASELINE
from benchmarks.curves import area_under, steps_to
from swarmjax import command
from swarmjax.config import ConfigError
from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import Interval, curve
from swarmjax.run.settings import TrainConfig

MEASURES = {"targets_reached": "targets reached", "all_reached": "episodes in which all arrived"}
THRESHOLDS = (0.8, 0.9)
COLUMNS = ("arm", "goal", "1.5 m", "to 0.8", "to 0.9", "area", "area (log)", "forgotten")
_SHARED = ("arena_steps", "levels", "level_seed", "steps", "roles", "robot", "realism")
_TYPES = {"arm": str, "goal": str, "policy": str, "arenas": int, "budget": int} | dict.fromkeys(
    ("roles", "judged"), dict
)
_TITLES = {"goal": "goal", "held_out": "1.5 m, never trained", "first": "first stage"}

Line = dict[str, Any]


class Key(NamedTuple):
    """The settings that all arms of a table share."""

    goal: str
    policy: str
    arenas: int
    budget: int


class Figures(NamedTuple):
    """The results of an arm; each field has one value per seed, [N].

    Attributes:
      goal: final share on the goal.
      held_out: final share in the 1.5 m arena; None if it was not judged.
      steps: arena steps until each threshold was first reached; inf if it was never reached.
      area: mean share over arena steps.
      log_area: mean share over the logarithm of arena steps.
      forgotten: best share on the first stage minus the final share on it; None if the first stage
        was not judged.
    """

    goal: np.ndarray
    held_out: np.ndarray | None
    steps: dict[float, np.ndarray]
    area: np.ndarray
    log_area: np.ndarray
    forgotten: np.ndarray | None


def tables(lines: Sequence[Line]) -> dict[Key, dict[str, Line]]:
    """Groups the lines by table and arm, with the baseline first.

    Args:
      lines: lines of `benchmarks.curriculum`.

    Returns:
      The arms of each table.

    Raises:
      ConfigError: if an arm appears twice, or arms of a table were judged differently. Arms may
        have different roles; only the roles that two arms share must have the same stage.
    """
    found: dict[Key, dict[str, Line]] = {}
    for line in sorted(lines, key=lambda line: line["arm"] != BASELINE):
        key = Key(*(line[name] for name in Key._fields))
        arms = found.setdefault(key, {})
        if line["arm"] in arms:
            raise ConfigError(f"arm {line['arm']} of {_title(key)} appears twice: leave one out.")
        for name in _SHARED:
            for other in arms.values():
                if _differs(name, line[name], other[name]):
                    raise ConfigError(
                        f"arms {other['arm']} and {line['arm']} of {_title(key)} differ in {name}: "
                        "judge them in the same way."
                    )
        arms[line["arm"]] = line
    return found


def _differs(name: str, one: Any, other: Any) -> bool:
    """Tells whether two lines differ in a shared setting; only roles of both lines are compared."""
    if name != "roles":
        return one != other
    return any(one[role] != other[role] for role in one.keys() & other.keys())


def figures(line: Line, measure: str) -> Figures:
    """Computes the results of each seed.

    Args:
      line: line of an arm.
      measure: one of `MEASURES`.

    Returns:
      The arm's figures.
    """
    steps = np.array(line["arena_steps"], float)
    curve = {role: np.array(found[measure]) for role, found in line["judged"].items()}
    goal, first = curve["goal"], curve.get("first")
    return Figures(
        goal=goal[:, -1],
        held_out=curve["held_out"][:, -1] if "held_out" in curve else None,
        steps={share: steps_to(steps, goal, share) for share in THRESHOLDS},
        area=area_under(steps, goal),
        log_area=area_under(np.log10(steps), goal),
        forgotten=None if first is None else first.max(axis=1) - first[:, -1],
    )


def table(key: Key, arms: dict[str, Line], measure: str) -> str:
    """Writes the table of some arms.

    Args:
      key: the settings that the arms share.
      arms: the line of each arm, by its name.
      measure: one of `MEASURES`.

    Returns:
      Markdown.
    """
    found = {name: figures(line, measure) for name, line in arms.items()}
    baseline = found.get(BASELINE)
    columns = [*COLUMNS, *(("P(end)", "P(area)") if baseline else ())]
    rows = [columns, ["---"] * len(columns)]
    rows += [[name, *_cells(mine), *_chances(mine, baseline)] for name, mine in found.items()]
    title = f"### {_title(key)}: {MEASURES[measure]}"
    return "\n".join([title, "", *(f"| {' | '.join(row)} |" for row in rows)])


def _title(key: Key) -> str:
    return f"{key.goal}, {key.policy}, {key.arenas} arenas, {key.budget:,} arena steps"


def _cells(mine: Figures) -> Iterator[str]:
    """Yields the cells of an arm's own results."""
    yield _share(mine.goal)
    yield _share(mine.held_out)
    for steps in mine.steps.values():
        yield _words(over_seeds(steps), _count)
    for values in (mine.area, mine.log_area, mine.forgotten):
        yield _share(values)


def _chances(mine: Figures, baseline: Figures | None) -> Iterator[str]:
    """Yields the cells of the probabilities that an arm beats the baseline."""
    if baseline is None:
        return
    for name in ("goal", "area"):
        chance = chance_of_seeds(getattr(mine, name), getattr(baseline, name))
        yield "-" if mine is baseline else _words(chance, "{:.2f}".format)


def chance_of_seeds(ours: np.ndarray, theirs: np.ndarray) -> Interval[float]:
    """Computes the probability that a value of ours [N] is higher than one of theirs [M]."""
    return statistics.probability_of_improvement(ours[:, None], theirs[:, None])


def over_seeds(values: np.ndarray) -> Interval[float]:
    """Computes the interquartile mean of values [N], with the mean's interval."""
    return statistics.bootstrap(values[:, None], statistics.iqm)


def _share(values: np.ndarray | None) -> str:
    return "-" if values is None else _words(over_seeds(values), "{:.3f}".format)


def _count(steps: float) -> str:
    """Writes a number of steps with two significant digits."""
    return "never" if np.isinf(steps) else f"{float(f'{steps:.2g}'):,.0f}"


def _words(interval: Interval[float], word: Callable[[float], str]) -> str:
    low, high = word(interval.low), word(interval.high)
    return f"{word(interval.estimate)} ({low} to {high})"


def draw(key: Key, arms: dict[str, Line], measure: str, path: Path) -> None:
    """Draws the learning curves of some arms, with the bands of their intervals.

    Args:
      key: the settings that the arms share.
      arms: the line of each arm, by its name.
      measure: one of `MEASURES`.
      path: path of the picture.
    """
    judged = {role for line in arms.values() for role in line["judged"]}
    roles = [role for role in _TITLES if role in judged]
    figure = Figure(figsize=(4.5 * len(roles), 3.8), layout="constrained")
    figure.suptitle(_title(key))
    for axes, role in zip(figure.subplots(1, len(roles), squeeze=False)[0], roles, strict=True):
        _draw_curves(axes, arms, role, measure)
    figure.savefig(path, dpi=150)


def _draw_curves(axes: Axes, arms: dict[str, Line], role: str, measure: str) -> None:
    """Draws the curves on one stage for the arms that were judged on it."""
    there = {name: line for name, line in arms.items() if role in line["judged"]}
    for name, line in there.items():
        band = curve(np.array(line["judged"][role][measure]))
        (drawn,) = axes.plot(line["arena_steps"], band.estimate, label=name)
        axes.fill_between(
            line["arena_steps"], band.low, band.high, color=drawn.get_color(), alpha=0.2, lw=0
        )
    stage = next(iter(there.values()))["roles"][role]
    axes.set(xscale="log", xlabel="arena steps", ylabel=f"{MEASURES[measure]}, IQM")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_title(f"{stage} ({_TITLES[role]})")
    axes.grid(visible=True, alpha=0.3)
    axes.legend()


def read(path: Path) -> list[Line]:
    """Reads the lines of a file.

    Raises:
      ConfigError: if the file cannot be read, or a line is damaged or not from
        `benchmarks.curriculum`.
    """
    try:
        texts = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}.") from None
    return [_line(text, f"{path} in line {n}") for n, text in enumerate(texts, 1) if text]


def _line(text: str, where: str) -> Line:
    """Reads a line and checks all values that a table needs."""
    try:
        line = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"{where} cannot be read: {error}.") from None
    if not isinstance(line, dict) or line.get("benchmark") != "curriculum":
        raise ConfigError(f"{where} is not a line of benchmarks.curriculum.")
    for key in ("arm", *Key._fields, *_SHARED, "judged"):
        if key not in line:
            raise ConfigError(f"{where} has no {key}: it is damaged.")
        if not isinstance(line[key], _TYPES.get(key, object)):
            raise ConfigError(f"{where} has {key} of another type: it is damaged.")
    _check_judged(line, where)
    return line


def _check_judged(line: Line, where: str) -> None:
    """Checks that a line has curves of its goal and that all its curves are complete."""
    if "goal" not in line["judged"]:
        raise ConfigError(f"{where} has no judged.goal: it is damaged.")
    for role, found in line["judged"].items():
        if role not in line["roles"]:
            raise ConfigError(f"{where} has no roles.{role}: it is damaged.")
        for measure in MEASURES:
            curves = found.get(measure) if isinstance(found, dict) else None
            if not _are_curves(line["arena_steps"], curves):
                raise ConfigError(
                    f"{where} has no curve of each seed over arena_steps as "
                    f"judged.{role}.{measure}: it is damaged."
                )


def _are_curves(steps: Any, curves: Any) -> bool:
    """Tells whether curves are [N, P] finite numbers over positive increasing steps [P]."""
    try:
        at, values = np.array(steps), np.array(curves)
        if {at.dtype.kind, values.dtype.kind} <= {"i", "f"} and values.ndim == 2:
            area_under(at, values)
            return bool(at[0] > 0)
    except ValueError:  # raised for ragged lists, or by the statistics
        return False
    return False


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given = dict(word.split("=", 1) for word in arguments if word.startswith(("out=", "measure=")))
    files = [word for word in arguments if not word.startswith(("out=", "measure="))]
    measure = given.get("measure", "targets_reached")
    if measure not in MEASURES:
        raise ConfigError(f"measure is '{measure}': give one of {', '.join(MEASURES)}.")
    if not files:
        raise ConfigError("no file is given: give files with lines of benchmarks.curriculum.")
    found = tables([line for name in files for line in read(Path(name))])
    if "out" in given:
        _draw_all(found, measure, Path(given["out"]))
    for key, arms in found.items():
        sys.stdout.write(table(key, arms, measure) + "\n\n")
    return 0


def _draw_all(found: dict[Key, dict[str, Line]], measure: str, out: Path) -> None:
    """Creates a directory and draws the learning curves of every table into it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for key, arms in found.items():
            draw(key, arms, measure, out / f"{'-'.join(map(str, (*key, measure)))}.png")
    except OSError as error:
        raise ConfigError(f"out is {out}, which cannot be written: {error.strerror}.") from None


if __name__ == "__main__":
    sys.exit(command.run("curriculum_table", main, TrainConfig))
