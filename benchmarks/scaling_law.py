"""How do more arenas and more training change the results of the default recipe?

`python -m benchmarks.scaling_law dir=DIR do=train|judge|table [key=value ...]` takes the keys of
`ScalingConfig`, and those of `swarmjax.train` for `do=train`.

- `train` trains `seeds` policies for every point, and writes them to `DIR`. A point is a
  combination of one of `arenas` and one of `transitions`. A transition is a control step of one of
  the five robots of an arena. The number of transitions determines `budget`. A point with less than
  one update is skipped, and its line says so.
- `judge` evaluates the policies on the wheeled robot in MuJoCo C, with drawn and with mean actions.
  It uses the suite `scaling`, which has the cells of the suite `headline`, and the cell
  `crowd_dense`, on which no policy was trained.
- `table` prints a JSON line for each point, cell and kind of action. The line also has the changes
  from the next smaller number of arenas and from the next smaller number of transitions. These
  changes are paired by level.

Each of the three commands continues from the contents of `DIR`, so it may be stopped at any time.
Judging may run on another machine than training.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

import swarmjax
from benchmarks import key_value
from swarmjax import command, outputs, provenance
from swarmjax.config import ConfigError, Section, about, show
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate import cells, statistics, trials
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.run.load_settings import load_run, load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.task.stage_files import load_levels

MEASURES = ("targets_reached", "all_reached", "contacts_per_robot", "episode_time_s")
ACTIONS = ("sampled", "mean")
_ROBOTS = 5  # robots per arena, to convert arena steps to transitions


@dataclass(frozen=True, kw_only=True)
class ScalingConfig(Section):
    """Settings: which points to train, and how to judge them."""

    dir: str = field(metadata=about("folder of the runs and of the judged results"))
    do: Literal["train", "judge", "table"] = field(metadata=about("what is done"))
    arenas: tuple[int, ...] = field(
        default=(128, 1024, 8192, 65_536), metadata=about("numbers of arenas", 1, 2**20)
    )
    transitions: tuple[float, ...] = field(
        default=(1e7, 1e8, 1e9), metadata=about("robot steps per seed", 1, 10**15)
    )
    seeds: int = field(default=5, metadata=about("policies per point", 3, 4096))
    seed: int = field(default=700, metadata=about("first of them", 0, MAX_COUNT))
    levels: int = field(default=200, metadata=about("levels of each cell to judge on", 1, 200))
    cells: tuple[str, ...] = field(
        default=("s6", "crowd_dense", "expanded", "r10", "r20"), metadata=about("that are judged")
    )


class Point(NamedTuple):
    """A point of the study: a number of arenas and a number of transitions."""

    arenas: int
    transitions: float

    def __str__(self) -> str:
        return f"a{self.arenas}-t{self.transitions:.0e}".replace("+", "")


def points(config: ScalingConfig) -> list[Point]:
    """Lists the points, starting with the fastest to train."""
    every = [Point(*each) for each in product(config.arenas, config.transitions)]
    return sorted(every, key=lambda point: (point.transitions, -point.arenas))


def training(config: ScalingConfig, point: Point, words: Sequence[str]) -> TrainConfig | None:
    """Makes the settings of a point's run; None if the point has less than one update.

    Raises:
      ConfigError: if an argument is invalid.
    """
    base = load_train(words)
    if point.transitions < _ROBOTS * point.arenas * base.algo.rollout_length:
        return None
    given = [
        f"arenas={point.arenas}",
        f"budget={round(point.transitions / _ROBOTS)}",
        f"seeds={config.seeds}",
        f"seed={config.seed}",
        f"run.dir={Path(config.dir) / str(point)}",
        "resume=auto",
    ]
    return load_run([*words, *given])[0]


def train(config: ScalingConfig, words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Trains the points that have no policies yet; yields a JSON line for each of them."""
    for point in points(config):
        place = Path(config.dir) / str(point)
        settings = training(config, point, words)
        if settings is not None and _updates(place) == settings.updates:
            continue
        line = {"benchmark": "scaling_law.train", **point._asdict(), "words": list(words)}
        if settings is None:
            yield line | {"skipped": "less than one update"}
            continue
        swarmjax.train_policy(settings)
        summary = json.loads((place / "summary.json").read_text())
        told = ("updates", "train_s", "compile_s", "device", "commit")
        line |= {name: summary.get(name) for name in told}
        yield line | {"trained_on": summary.get("transitions")}


def _updates(place: Path) -> int:
    """Reads the number of updates of a finished run; 0 if the run has not finished."""
    summary = place / "summary.json"
    return json.loads(summary.read_text())["updates"] if summary.exists() else 0


def policies(config: ScalingConfig, point: Point) -> list[str]:
    """Lists the policy files of a point, by seed; the list is empty before training."""
    return sorted(str(file) for file in (Path(config.dir) / str(point)).glob("policy-seed*.npz"))


def judged_file(config: ScalingConfig, point: Point, cell: str, action: str) -> Path:
    """Names the file that holds a point's measures [seeds, levels]."""
    return Path(config.dir) / "judged" / f"{point}-{cell}-{action}.npz"


def judge(config: ScalingConfig) -> Iterator[dict[str, Any]]:
    """Judges the points that have not been judged yet, cell by cell; yields their means."""
    trained = {point: policies(config, point) for point in points(config)}
    some = next((files[0] for files in trained.values() if files), None)
    if some is None:
        raise ConfigError(f"dir is {show(config.dir)}, which holds no policies: do=train first.")
    settings = load_levels(EvaluateConfig, [f"policy={some}", "suite=scaling", "robot=wheeled"])
    for cell, action in product(_chosen(config, settings), ACTIONS):
        places = {point: judged_file(config, point, cell.name, action) for point in trained}
        left = {point: files for point, files in trained.items() if not places[point].exists()}
        for point, found in _try(replace(settings, action=action), left, cell).items():
            with outputs.replacing(places[point]) as temporary:
                np.savez(temporary, allow_pickle=False, **found)
            means = {name: round(float(x.mean()), 5) for name, x in found.items()}
            yield {"point": str(point), "cell": cell.name, "action": action, **means}


def _chosen(config: ScalingConfig, settings: EvaluateConfig) -> list[Cell]:
    """Returns the requested cells, each with its first `levels` levels."""
    found = {cell.name: cell for cell in cells.load(settings).cells}
    for name in config.cells:
        if name not in found:
            raise ConfigError(f"cells has {show(name)}: give some of {', '.join(found)}.")
    first = slice(config.levels)
    return [
        cell._replace(
            levels=jax.tree.map(lambda array: array[first], cell.levels),
            episodes=cell.episodes[first],
        )
        for cell in (found[name] for name in config.cells)
    ]


def _try(
    settings: EvaluateConfig, trained: dict[Point, list[str]], cell: Cell
) -> dict[Point, dict[str, np.ndarray]]:
    """Judges the policies of points on a cell; returns each measure's values [seeds, levels]."""
    files = [file for each in trained.values() for file in each]
    if not files:
        return {}
    (trial,) = trials.run(settings, [cell], trials.read_policies(files))
    ends = np.cumsum([len(each) for each in trained.values()])[:-1]
    split = {name: np.split(trial.found[name], ends) for name in MEASURES}
    found = [dict(zip(split, each, strict=True)) for each in zip(*split.values(), strict=True)]
    return {point: each for (point, own), each in zip(trained.items(), found, strict=True) if own}


def table(config: ScalingConfig) -> Iterator[dict[str, Any]]:
    """Yields a line for every judged point, cell and kind of action."""
    for path in sorted((Path(config.dir) / "judged").glob("*-sampled.npz")):
        head = path.name.removesuffix("-sampled.npz")
        for point in points(config):
            if head.startswith(f"{point}-"):
                cell = head.removeprefix(f"{point}-")
                files = {each: judged_file(config, point, cell, each) for each in ACTIONS}
                there = [action for action, file in files.items() if file.exists()]
                yield from (_line(config, point, cell, action) for action in there)


def _line(config: ScalingConfig, point: Point, cell: str, action: str) -> dict[str, Any]:
    found = _load(config, point, cell, action)
    assert found is not None  # its file exists
    line: dict[str, Any] = {
        "benchmark": "scaling_law",
        **point._asdict(),
        "cell": cell,
        "action": action,
        "seeds": list(range(config.seed, config.seed + len(found["all_reached"]))),
        "levels": found["all_reached"].shape[1],
    }
    for name, values in found.items():
        estimate, low, high = statistics.bootstrap(values, np.mean, draw="runs_and_tasks")
        line |= {name: estimate, f"{name}_interval": [low, high]}
        line[f"{name}_by_seed"] = values.mean(axis=1).round(5).tolist()
    for what, smaller in _smaller(config, point).items():
        before = _load(config, smaller, cell, action)
        for name in found if before else ():
            assert before is not None
            change = statistics.paired(before[name], found[name], np.mean, draw="runs_and_tasks")
            line[f"{name}_by_{what}"] = list(change)
    return line | {"versions": provenance.versions(), "commit": provenance.commit()}


def _smaller(config: ScalingConfig, point: Point) -> dict[str, Point]:
    """Returns the points with the next smaller `arenas` and `transitions`, if they exist."""
    arenas = [each for each in config.arenas if each < point.arenas]
    transitions = [each for each in config.transitions if each < point.transitions]
    found = {}
    if arenas:
        found["arenas"] = point._replace(arenas=max(arenas))
    if transitions:
        found["transitions"] = point._replace(transitions=max(transitions))
    return found


def _load(
    config: ScalingConfig, point: Point, cell: str, action: str
) -> dict[str, np.ndarray] | None:
    place = judged_file(config, point, cell, action)
    if not place.exists():
        return None
    with np.load(place) as file:
        return {name: file[name] for name in MEASURES}


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    config, words = key_value.parse(ScalingConfig, arguments)
    lines = {
        "train": lambda: train(config, words),
        "judge": lambda: judge(config),
        "table": lambda: table(config),
    }[config.do]()
    for line in lines:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("scaling_law", main, TrainConfig))
