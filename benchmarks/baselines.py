"""How good are controllers without learning, on the levels and in the engine of `evaluate`?

`python -m benchmarks.baselines suite=NAME [who=straight,bug2,orca] [evaluate keys]` judges each
controller in MuJoCo C and prints a JSON line for each controller and cell. `stage=NAME` may replace
`suite=NAME`. The controllers are:

- `straight` drives straight to the target and ignores the infrared sensors. `still` never moves.
- `bug2` follows the outlines of obstacles. It uses a robot's ten observations and a memory
  (`benchmarks.bug2`).
- `orca`, `hrvo`, `hl` and `social_force` use the positions of all robots and the map
  (`benchmarks.planners`). These four need the extra `navground`.

`beside=a.npz,b.npz` also judges policies of one recipe, with the robot that they were trained with.
Each line then compares the baseline with the policies, level by level: `difference` is the mean of
the policies minus that of the baseline. To judge both with the same hulls, give
`robot.hull_friction`.
"""

import math
import platform
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import bug2, key_value, peers, planners
from swarmjax import command, epuck, policy_file, provenance, words
from swarmjax.config import ConfigError, Section, about, show, to_dict
from swarmjax.evaluate import cells, engine_c, measures, summary, trials, witness
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.engine_c import Controller
from swarmjax.evaluate.evaluation import list_files
from swarmjax.evaluate.judge import Judge
from swarmjax.evaluate.measures import Outcome
from swarmjax.policy import Policy
from swarmjax.task import observation
from swarmjax.task.level import Level
from swarmjax.task.stage_files import load_levels

# The action (speed, turn rate; -1..1) at bearing 0, then the change of the action per radian of
# bearing to the left, and per radian to the right. In `straight` the turn rate is twice the
# bearing, and the speed is full at bearing 0 and falls with the bearing.
POLICIES = {
    "straight": ((1.0, 0.0), (-2.0, 2.0), (-2.0, -2.0)),
    "still": ((-1.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
}
NAMES = (*POLICIES, "bug2", *planners.SETTINGS)
BATCH = 32  # arenas per process at once; with 40 robots on 4 x 4 m the planned paths take 0.2 GB
_FIXED = (
    "policy",
    "compare",
    "engine",
    "action",
    "out",
)  # keys of `evaluate` that baselines reject


@dataclass(frozen=True, kw_only=True)
class BaselinesConfig(Section):
    """Settings: which baselines are judged."""

    who: tuple[str, ...] = field(
        default=("straight", "still", "bug2"), metadata=about("baselines, one after the other")
    )
    beside: str | None = field(
        default=None,
        metadata=about("policies to compare with: a.npz, several of one recipe, or a pattern"),
    )

    def _check(self) -> None:
        for name in self.who:
            if name not in NAMES:
                raise ConfigError(f"who is {show(name)}: give some of {', '.join(NAMES)}.")


class _Batch(NamedTuple):
    """Levels that one process runs with one baseline."""

    config: EvaluateConfig
    policy: Policy
    who: str
    half: np.ndarray
    levels: Level


def write(path: Path, ahead: Sequence[float], *sides: Sequence[float]) -> None:
    """Writes a policy that is piecewise linear in the bearing.

    Args:
      path: path of the `policy.npz`.
      ahead: [2] action at bearing 0.
      sides: change of the action [2] per radian of bearing to the left, and to the right.
    """
    split = np.zeros((1, observation.SIZE, 2), np.float32)
    split[0, observation.NAMES.index("target_bearing")] = [1.0, -1.0]
    none = np.zeros((1, observation.SIZE), np.float32)
    arrays = {
        "actor/hidden_0/kernel": split,
        "actor/hidden_0/bias": none[:, :2],
        "actor/mean/kernel": np.array([sides], np.float32),
        "actor/mean/bias": np.array([ahead], np.float32),
        "actor/log_std": none[:, :2] - 200.0,  # exp(-200) is 0 in float32
        "normalizer/mean": none,
        "normalizer/std": none + 1.0,
    }
    turn = epuck.MAX_TURN_RATE
    meta = {
        "policy": "shared",
        "learners": 1,
        "activation": "relu",
        "observation": observation.describe("metric") | {"limit": 10.0},
        "action": {
            "names": ["speed", "turn_rate"],
            "units": ["m/s", "rad/s"],
            "low": [0.0, -turn],
            "high": [epuck.MAX_SPEED, turn],
        },
        "robot": {
            "preset": "planar",
            "body": "planar",
            "wheel_radius": epuck.WHEEL_RADIUS,
            "track": epuck.TRACK,
            "max_wheel_speed": epuck.MAX_WHEEL_SPEED,
        },
        "sensors": {"preset": "ideal", "response": "ideal", "range": epuck.SENSOR_RANGE},
        "task": {"control_step": 0.032, "target_radius": 0.05, "arrival": "latch"},
        "realism": {"name": "ideal", "infrared": "ideal"},
        "stages": [],
        "extensions": {},
        "seed": 0,
        "config": {},
        "versions": provenance.versions(),
        "update": 0,
    }
    policy_file.write(path, arrays, meta)


def results(
    who: Sequence[str], arguments: Sequence[str], beside: str | None = None
) -> Iterator[dict[str, Any]]:
    """Judges baselines.

    Args:
      who: some of `NAMES`.
      arguments: keys of `evaluate`.
      beside: policies to compare with, as `policy` of `evaluate` names them.

    Yields:
      A line for each baseline and each cell.

    Raises:
      ConfigError: if a key is invalid, or a package is missing.
    """
    for word in arguments:
        if word.partition("=")[0] in _FIXED:
            key = word.partition("=")[0]
            raise ConfigError(f"{key} cannot be given for baselines: leave it out.")
    if set(who) & set(planners.SETTINGS):
        planners.check_packages()
    settings, policies = _read(who, arguments)
    suite = cells.load(settings)
    pairs = [(name, cell) for name in who for cell in suite.cells]
    workers = settings.workers or provenance.cores()
    jobs = [_split(settings, policies[name], name, cell, workers) for name, cell in pairs]
    flat = [job for mine in jobs for job in mine]
    theirs = {} if beside is None else judge_policies(beside, arguments, suite.cells)
    done = trials.work(_simulate, flat, min(workers, len(flat)))
    for (name, cell), batches in zip(pairs, jobs, strict=True):
        parts, seconds = zip(*(next(done) for _ in batches), strict=True)
        outcome = Outcome(*map(np.concatenate, zip(*parts, strict=True)))
        mine = trials.specialise(settings, cell, settings.policy)
        found = measures.per_level(outcome, settings.task.control_step, mine.step_limit)
        line = _line(mine, suite.name, name, cell, found)
        if beside is not None:
            line |= {"beside": beside, "compared": compare(found, theirs[cell.digest])}
        yield line | {"cpu_s": sum(seconds)}


def judge_policies(
    beside: str, arguments: Sequence[str], baseline_cells: Sequence[Cell]
) -> dict[str, dict[str, np.ndarray]]:
    """Judges policies as `evaluate` does.

    Args:
      beside: the policies, as `policy` of `evaluate` names them.
      arguments: keys of `evaluate`.
      baseline_cells: the cells on which the baselines are judged.

    Returns:
      The values [P, E] of each measure, by the digest of the cell.

    Raises:
      ConfigError: if the policies would be judged on other levels.
    """
    settings, _ = witness.load(EvaluateConfig, [*arguments, f"policy={beside}"])
    entrants = trials.read_policies(list_files("beside", beside), settings.extensions)
    suite = cells.load(settings)
    if {cell.digest for cell in suite.cells} != {cell.digest for cell in baseline_cells}:
        raise ConfigError(f"beside is {beside}, which has other levels: give a stage.")
    return {each.cell.digest: each.found for each in trials.run(settings, suite.cells, entrants)}


def compare(
    baseline: dict[str, np.ndarray], policies: dict[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Compares a baseline with policies, level by level.

    Args:
      baseline: values [E] of each measure.
      policies: values [P, E] of each measure, on the same levels.

    Returns:
      For each measure that both have, the entries of `summary.compare`. The baseline is `a`.
    """
    count = len(next(iter(policies.values())))
    repeated = {name: np.tile(values, (count, 1)) for name, values in baseline.items()}
    return summary.compare(repeated, policies)


def _read(who: Sequence[str], arguments: Sequence[str]) -> tuple[EvaluateConfig, dict[str, Policy]]:
    """Reads the settings, and the policy with which each baseline is judged.

    For a baseline that is not a policy, the file only gives the range of commands.
    """
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.npz"
        settings = load_levels(EvaluateConfig, [*arguments, f"policy={path}"])
        for name in who:
            write(path, *POLICIES.get(name, POLICIES["still"]))
            found[name] = policy_file.read(str(path))
    return settings, found


def _split(
    settings: EvaluateConfig, policy: Policy, who: str, cell: Cell, workers: int
) -> list[_Batch]:
    """Splits the levels of a cell into batches."""
    count, mine = len(cell.episodes), trials.specialise(settings, cell, settings.policy)
    size = min(BATCH, math.ceil(count / workers))
    rows = [slice(first, first + size) for first in range(0, count, size)]
    parts = [Level(*(each[part] for each in cell.levels)) for part in rows]
    return [_Batch(mine, policy, who, cell.half, part) for part in parts]


def _simulate(job: _Batch) -> tuple[Outcome, float]:
    """Runs a batch; returns its outcome and the processor time in seconds."""
    began = time.process_time()
    judge = evaluate_judge.load(job.config, job.policy, job.half)
    outcome = engine_c.simulate(judge, cells.split(job.levels), controller(job.who, judge))
    return outcome, time.process_time() - began


def controller(who: str, judge: Judge) -> Controller | None:
    """Makes the controller of a baseline; returns None for a baseline that is only a policy."""
    if who in POLICIES:
        return None
    return bug2.load(judge) if who == "bug2" else planners.load(who, judge)


def _line(
    settings: EvaluateConfig,
    suite: str | None,
    who: str,
    cell: Cell,
    found: dict[str, np.ndarray],
) -> dict[str, Any]:
    """Returns a baseline's results on a cell as plain data for JSON; settings are the cell's."""
    packages = ("navground", "scipy") if who in planners.SETTINGS else ()
    return {
        "benchmark": "baselines",
        "who": who,
        "suite": suite,
        "cell": cell.name,
        "stage": to_dict(cell.stage),
        "shape": cell.shape,
        "realism": to_dict(settings.realism),
        "episodes": len(cell.episodes),
        "seed": cell.seed,
        "digest": cell.digest,
        "measures": summary.summarize({name: table[None] for name, table in found.items()}),
        "robot": to_dict(settings.robot),
        "task": to_dict(settings.task),
        "steps": settings.step_limit,
        "substeps": evaluate_judge.substeps(settings),
        "device": f"CPU {platform.machine()}, {words.count(provenance.cores(), 'core')}",
        "versions": peers.versions(*packages),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    mine, others = key_value.parse(BaselinesConfig, arguments)
    peers.write(results(mine.who, others, mine.beside))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("baselines", main, EvaluateConfig))
