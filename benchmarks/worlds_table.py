"""Makes tables from the lines that `benchmarks.worlds_study` has printed.

`python -m benchmarks.worlds_table FILE...` prints two Markdown tables. The first table has a row
for each arm. Its intervals are 95 % intervals from a bootstrap over seeds
(swarmjax.evaluate.statistics). A seed's score at a point is the share of levels in which all robots
arrive, as a mean over the families. The columns are:

- `all arrive`: interquartile mean of the scores at the end.
- `to 0.9`, `to 0.95`: arena steps until a seed first has this score; interquartile mean.
- `worst 5 %`: mean of the worst twentieth of all results; each seed has one result for each family.
- `contacts`: contacts per robot, as a mean over the families; interquartile mean over seeds.
- `P(end)`: probability that a seed has a higher score at the end than a seed of `random`.
- `P(area)`: probability that a seed has a higher mean score over all points.

The second table has a row for each family and a column for each arm, with the mean of `all arrive`
over seeds.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.curriculum_table import chance_of_seeds, over_seeds
from benchmarks.curves import steps_to
from swarmjax import command
from swarmjax.config import ConfigError
from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import Interval
from swarmjax.run.settings import TrainConfig

BASELINE = "random"
THRESHOLDS = (0.9, 0.95)
_KEYS = ("arm", "seeds", "arena_steps", "judged", "levels", "level_seed", "steps")
_SHARED = ("arena_steps", "levels", "level_seed", "steps")

Line = dict[str, Any]


def read(path: Path) -> list[Line]:
    """Reads the lines of a file.

    Raises:
      ConfigError: If the file cannot be read, or a line is not from `benchmarks.worlds_study`.
    """
    try:
        lines = [json.loads(text) for text in path.read_text().splitlines() if text]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}.") from None
    for number, line in enumerate(lines, 1):
        if not isinstance(line, dict) or line.get("benchmark") != "worlds_study":
            raise ConfigError(f"{path}, line {number} is not a line of benchmarks.worlds_study.")
        for key in _KEYS:
            if key not in line:
                raise ConfigError(f"{path}, line {number} has no {key}: it is damaged.")
    return lines


def merge(lines: Sequence[Line]) -> dict[str, Line]:
    """Joins the lines of each arm, since several runs may have trained seeds of one arm.

    Args:
      lines: The lines that `benchmarks.worlds_study` printed.

    Returns:
      A line for each arm, the baseline first.

    Raises:
      ConfigError: If an arm has the same seed twice, or lines were judged differently.
    """
    found: dict[str, Line] = {}
    for line in sorted(lines, key=lambda line: line["arm"] != BASELINE):
        for key in _SHARED:
            if line[key] != lines[0][key]:
                raise ConfigError(
                    f"arm {line['arm']} has {key} {line[key]}, but {lines[0]['arm']} has "
                    f"{lines[0][key]}: compare lines of one study."
                )
        mine = found.get(line["arm"])
        found[line["arm"]] = line if mine is None else _joined(mine, line)
    return found


def _joined(one: Line, other: Line) -> Line:
    """Joins two lines of an arm."""
    twice = set(one["seeds"]) & set(other["seeds"])
    if twice:
        raise ConfigError(f"arm {one['arm']} has seed {min(twice)} twice: leave one line out.")
    judged = {
        family: {name: [*values, *other["judged"][family][name]] for name, values in found.items()}
        for family, found in one["judged"].items()
    }
    return one | {"seeds": [*one["seeds"], *other["seeds"]], "judged": judged}


def curves(line: Line, measure: str) -> np.ndarray:
    """Returns an arm's values of a measure, [N seeds, F families, P points]."""
    return np.stack([np.array(found[measure]) for found in line["judged"].values()], axis=1)


def arms_table(arms: dict[str, Line]) -> str:
    """Makes the Markdown table of the arms."""
    columns = ["arm", "all arrive", *(f"to {share}" for share in THRESHOLDS)]
    columns += ["worst 5 %", "contacts", "P(end)", "P(area)"]
    rows = [f"| {' | '.join(columns)} |", f"|---|{'--:|' * (len(columns) - 1)}"]
    baseline = arms.get(BASELINE)
    for name, line in arms.items():
        cells = [name, *_cells(line), *_chances(line, baseline)]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def _cells(line: Line) -> Iterator[str]:
    """Yields the table cells of an arm's own results."""
    arrive, contacts = curves(line, "all_reached"), curves(line, "contacts_per_robot")
    score = arrive.mean(axis=1)
    yield _interval(over_seeds(score[:, -1]), _decimals)
    for share in THRESHOLDS:
        yield _interval(over_seeds(steps_to(line["arena_steps"], score, share)), _steps)
    yield _interval(statistics.bootstrap(arrive[..., -1], _worst), _decimals)
    yield _interval(over_seeds(contacts[..., -1].mean(axis=1)), _decimals)


def _chances(line: Line, baseline: Line | None) -> Iterator[str]:
    """Yields the cells of the probabilities that a seed of an arm beats one of the baseline."""
    if baseline is None or line is baseline:
        yield from ("-", "-")
        return
    ours, theirs = (curves(each, "all_reached").mean(axis=1) for each in (line, baseline))
    yield _interval(chance_of_seeds(ours[:, -1], theirs[:, -1]), _decimals)
    yield _interval(chance_of_seeds(ours.mean(axis=1), theirs.mean(axis=1)), _decimals)


def _worst(values: np.ndarray, axis: tuple[int, ...]) -> np.ndarray:
    return np.asarray(statistics.cvar(values, axis=axis))


def _interval(found: Interval[float], show: Callable[[float], str]) -> str:
    return f"{show(found.estimate)} [{show(found.low)}, {show(found.high)}]"


def _decimals(value: float) -> str:
    return f"{value:.3f}"


def _steps(steps: float) -> str:
    return "never" if np.isinf(steps) else f"{steps:.1e}".replace("e+0", "e")


def families_table(arms: dict[str, Line]) -> str:
    """Makes the Markdown table of the families."""
    rows = [f"| family | {' | '.join(arms)} |", f"|---|{'--:|' * len(arms)}"]
    first = next(iter(arms.values()))
    for i, family in enumerate(first["judged"]):
        means = [curves(line, "all_reached")[:, i, -1].mean() for line in arms.values()]
        cells = " | ".join(f"{mean:.2f}" for mean in means)
        rows.append(f"| `{family.removeprefix('world_')}` | {cells} |")
    return "\n".join(rows)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    if not arguments:
        raise ConfigError(
            "no file is given: give files of lines that benchmarks.worlds_study printed."
        )
    arms = merge([line for name in arguments for line in read(Path(name))])
    sys.stdout.write(f"{arms_table(arms)}\n\n{families_table(arms)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("worlds_table", main, TrainConfig))
