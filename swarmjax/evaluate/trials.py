"""Runs every policy on every cell, split over processes or in the training engine."""

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import islice
from multiprocessing import get_context, parent_process
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from swarmjax import extension, policy_file, provenance
from swarmjax.config import build, files
from swarmjax.evaluate import engine_c, measures, shortest_path
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.cells import Cell, split
from swarmjax.evaluate.config import STEPS, EvaluateConfig
from swarmjax.evaluate.measures import Measure, Outcome
from swarmjax.policy import Policy
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.goals import load as goals
from swarmjax.task.level import Level

BATCH = 64  # arenas that share NumPy's cost per call; larger batches gain little


class Entrant(NamedTuple):
    """A policy to evaluate, and the path of its file."""

    path: str
    policy: Policy


class Trial(NamedTuple):
    """The results of policies on the levels of a cell.

    Attributes:
      cell: Cell with E levels.
      shortest: [E, R] lengths of the shortest paths, m; inf if a target cannot be reached.
      measures: [P, E] of each measure that the engine computes.
      own: The goal's own measures.
    """

    cell: Cell
    shortest: np.ndarray
    measures: dict[str, np.ndarray]
    own: Mapping[str, Measure] = MappingProxyType({})


class _Job(NamedTuple):
    """Levels [A] of a cell for one process, and the half edges of the cell's boxes."""

    config: EvaluateConfig
    entrants: Sequence[Entrant]
    half: np.ndarray
    levels: Level


# The outcome of each policy on some levels, and the lengths of their shortest paths.
type _Result = tuple[list[Outcome], np.ndarray]


def read_policies(files: Sequence[str], extensions: str | None = None) -> list[Entrant]:
    """Reads policy files.

    Args:
      files: Their paths.
      extensions: Value of the key `extensions`.

    Raises:
      PolicyError: A file is invalid.
    """
    return [Entrant(file, policy_file.read(file, extensions)) for file in files]


def run(
    config: EvaluateConfig,
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None] = lambda _: None,
) -> Iterator[Trial]:
    """Evaluates policies on cells.

    Args:
      config: Settings of the evaluation.
      cells: Cells with the levels.
      entrants: The policies.
      report: Called from time to time with the number of episodes finished since the last call.

    Yields:
      A trial for each cell, as soon as it is finished.

    Raises:
      ConfigError: A cell does not fit the settings, or the physics breaks down.
    """
    # Checks all cells before the first one runs.
    configs = [specialise(config, cell) for cell in cells]
    play = _by_mjx if config.engine == "mjx" else _by_c
    played = play(configs, cells, entrants, report)
    for mine, cell, (outcomes, shortest) in zip(configs, cells, played, strict=True):
        yield _try(mine, cell, outcomes, shortest)


def specialise(config: EvaluateConfig, cell: Cell) -> EvaluateConfig:
    """Makes the settings for one cell.

    Args:
      config: Settings of the evaluation.
      cell: Cell whose stage and seed to use, its realism if it has one, and its step limit if
        `config` has none.

    Returns:
      The settings.
    """
    realism = config.realism
    if cell.realism is not None:
        realism = build(RealismConfig, files.read_choice("realism", cell.realism))
    return replace(
        config,
        suite=None,
        stage=cell.stage,
        realism=realism,
        steps=(cell.steps or STEPS) if config.steps is None else config.steps,
        seed=cell.seed,
        episodes=len(cell.episodes),
    )


def _try(
    config: EvaluateConfig, cell: Cell, outcomes: Sequence[Outcome], shortest: np.ndarray
) -> Trial:
    """Builds a trial from the policies' outcomes on a cell."""
    goal = goals.load(config.task, config.robot, extension.load(config.extensions).goals)
    # Path efficiency is not defined for targets that move.
    known = None if goal.moves else shortest
    shortest = np.zeros_like(shortest) if goal.moves else shortest
    second, steps, own = config.task.control_step, config.step_limit, goal.measures
    rows = [measures.per_level(each, second, steps, known, own) for each in outcomes]
    tables = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return Trial(cell, shortest, tables, own)


def _by_mjx(
    configs: Sequence[EvaluateConfig],
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None],
) -> Iterator[_Result]:
    """Runs each cell at once in the training engine."""
    from swarmjax.evaluate import engine_mjx
    from swarmjax.run import compile_cache  # these modules need JAX

    for config, cell in zip(configs, cells, strict=True):
        outcomes, sampled = [], config.action == "sampled"
        with compile_cache.use():
            world = engine_mjx.load(config, cell.largest_half, len(cell.episodes))
            for _, trained in entrants:
                outcomes.append(
                    engine_mjx.play(world, cell.levels, trained, config.step_limit, sampled=sampled)
                )
                report(len(cell.episodes))
        yield outcomes, ways(config, cell.levels)


def _by_c(
    configs: Sequence[EvaluateConfig],
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None],
) -> Iterator[_Result]:
    """Runs all episodes in batches, in as many processes as are useful."""
    workers = configs[0].workers or provenance.cores()
    jobs = [_jobs(*each, entrants, workers) for each in zip(configs, cells, strict=True)]
    every = [job for mine in jobs for job in mine]
    done = work(_simulate, every, min(workers, len(every)))
    for mine in jobs:
        batches = []
        for outcomes, lengths in islice(done, len(mine)):
            batches.append((outcomes, lengths))
            report(len(lengths) * len(outcomes))
        parts, shortest = zip(*batches, strict=True)
        by_policy = zip(*parts, strict=True)
        whole = [Outcome(*map(np.concatenate, zip(*each, strict=True))) for each in by_policy]
        yield whole, np.concatenate(shortest)


def _jobs(
    config: EvaluateConfig, cell: Cell, entrants: Sequence[Entrant], workers: int
) -> list[_Job]:
    """Splits the levels of a cell into batches."""
    count = len(cell.episodes)
    size = min(BATCH, math.ceil(count / workers))
    rows = [slice(first, first + size) for first in range(0, count, size)]
    parts = [Level(*(field[part] for field in cell.levels)) for part in rows]
    return [_Job(config, entrants, cell.half, part) for part in parts]


def work[Job, Result](
    function: Callable[[Job], Result], jobs: Sequence[Job], workers: int
) -> Iterator[Result]:
    """Runs jobs in order, and yields their results in the same order.

    Args:
      function: Function of a module, so that other processes find it.
      jobs: Its arguments.
      workers: Number of processes; 1 means this process alone.
    """
    if workers <= 1:
        yield from map(function, jobs)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin_worker) as pool:
        yield from pool.map(function, jobs)


def _begin_worker() -> None:
    """Prepares a worker process."""
    # Ctrl-C ends the process at once and silently; its parent prints the message.
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Extensions run on JAX. On a GPU, each process would reserve most of the GPU's memory.
    os.environ["JAX_PLATFORMS"] = "cpu"
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Ends this process when its parent dies; otherwise it would go on running."""
    parent = parent_process()
    assert parent is not None  # this process was spawned
    parent.join()
    os._exit(1)


def _simulate(job: _Job) -> _Result:
    """Runs each policy on the levels of a job."""
    levels = split(job.levels)
    judges = [evaluate_judge.load(job.config, each.policy, job.half) for each in job.entrants]
    outcomes = [engine_c.simulate(judge, levels) for judge in judges]
    return outcomes, ways(job.config, job.levels)


def ways(config: EvaluateConfig, levels: Level) -> np.ndarray:
    """Finds the lengths of the shortest paths from starts to targets.

    Args:
      config: Settings with the radii of robots and targets.
      levels: [E].

    Returns:
      [E, R] m; inf where there is no path.
    """
    start, hull, reach = levels.start[..., :2], config.robot.hull_radius, config.task.target_radius
    return shortest_path.shortest(levels.side, start, levels.target, levels.obstacle, hull, reach)
