"""Runs every policy on every cell, split over processes or in the training engine."""

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import batched, islice
from multiprocessing import get_context, parent_process
from typing import NamedTuple

import numpy as np

from swarmjax import policy_file, provenance
from swarmjax.config import build, files
from swarmjax.evaluate import engine_c, measures, shortest_path
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.cells import Cell, split
from swarmjax.evaluate.config import STEPS, EvaluateConfig
from swarmjax.evaluate.measures import Outcome
from swarmjax.policy import Policy
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.level import Level

BATCH = 64  # arenas that share NumPy's cost per call; larger batches gain little


class Entrant(NamedTuple):
    """A policy to judge, and the path of its file."""

    path: str
    policy: Policy


class Trial(NamedTuple):
    """The results of policies on the levels of a cell.

    Attributes:
      cell: Cell with E levels.
      shortest: [E, R] lengths of the shortest paths, m; inf if a target cannot be reached.
      measures: [P, E] of each measure that the engine computes.
    """

    cell: Cell
    shortest: np.ndarray
    measures: dict[str, np.ndarray]


class _Job(NamedTuple):
    """Levels for one process and one policy, and whether the process also finds shortest paths."""

    config: EvaluateConfig
    policy: Policy
    half: np.ndarray
    levels: Level
    find_ways: bool


# The outcome of each policy on a cell, and the lengths of the cell's shortest paths.
type _Result = tuple[list[Outcome], np.ndarray]


def read_policies(files: Sequence[str], extensions: str | None = None) -> list[Entrant]:
    """Reads policy files.

    Args:
      files: Their paths.
      extensions: Value of the key `extensions`.

    Raises:
      PolicyError: A file is unsound.
    """
    return [Entrant(file, policy_file.read(file, extensions)) for file in files]


def run(
    config: EvaluateConfig,
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None] = lambda _: None,
) -> Iterator[Trial]:
    """Judges policies on cells.

    Args:
      config: Settings of the evaluation.
      cells: Cells with the levels.
      entrants: The policies.
      report: Called from time to time with the number of episodes finished since the last call.

    Yields:
      A trial for each cell, as soon as it is finished.

    Raises:
      PolicyError: A policy does not fit a cell.
      ConfigError: The physics breaks down.
    """
    for cell in cells:
        for each in entrants:
            evaluate_judge.check_policy(config, cell.stage, *each)
    # Checks all cells before the first one runs.
    configs = [specialise(config, cell) for cell in cells]
    play = _by_mjx if config.engine == "mjx" else _by_c
    played = play(config, cells, entrants, report)
    for mine, cell, (outcomes, shortest) in zip(configs, cells, played, strict=True):
        yield _try(mine, cell, outcomes, shortest)


def specialise(config: EvaluateConfig, cell: Cell, path: str | None = None) -> EvaluateConfig:
    """Makes the settings for one cell, and for one policy.

    Args:
      config: Settings of the evaluation.
      cell: Cell that sets the stage, shape and seed. A cell with values for realism or hull
        friction sets these too. A cell with a step limit sets it if `config` has none.
      path: Path of the policy.

    Returns:
      The settings.
    """
    realism = config.realism
    if cell.realism is not None:
        realism = build(RealismConfig, files.read_choice("realism", cell.realism))
    robot = config.robot
    if cell.hull_friction is not None:
        robot = replace(robot, hull_friction=cell.hull_friction)
    return replace(
        config,
        robot=robot,
        policy=path or config.policy,
        compare=None if path else config.compare,
        suite=None,
        stage=cell.stage,
        shape=cell.shape,
        realism=realism,
        steps=(cell.steps or STEPS) if config.steps is None else config.steps,
        seed=cell.seed,
        episodes=len(cell.episodes),
    )


def _try(
    config: EvaluateConfig, cell: Cell, outcomes: Sequence[Outcome], shortest: np.ndarray
) -> Trial:
    """Builds a trial from the policies' outcomes on a cell."""
    second = config.task.control_step
    rows = [measures.per_level(each, second, config.step_limit, shortest) for each in outcomes]
    tables = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return Trial(cell, shortest, tables)


def _by_mjx(
    config: EvaluateConfig,
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None],
) -> Iterator[_Result]:
    """Runs each cell at once in the training engine."""
    from swarmjax.evaluate import engine_mjx
    from swarmjax.run import compile_cache  # these modules need JAX

    for cell in cells:
        mine, outcomes = specialise(config, cell, entrants[0].path), []
        with compile_cache.use():
            world = engine_mjx.load(mine, cell.largest_half, len(cell.episodes))
            for each in entrants:
                sampled, steps = config.action == "sampled", mine.step_limit
                outcomes.append(
                    engine_mjx.play(world, cell.levels, each.policy, steps, sampled=sampled)
                )
                report(len(cell.episodes))
        yield outcomes, ways(mine, cell.levels)


def _by_c(
    config: EvaluateConfig,
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None],
) -> Iterator[_Result]:
    """Runs all episodes in batches, in as many processes as are useful."""
    workers = config.workers or provenance.cores()
    jobs = [
        [
            job
            for i, each in enumerate(entrants)
            for job in _jobs(config, cell, each, workers, find_ways=not i)
        ]
        for cell in cells
    ]
    every = [job for mine in jobs for job in mine]
    done = work(_simulate, every, min(workers, len(every)))
    for mine in jobs:
        parts = []
        for part in islice(done, len(mine)):
            parts.append(part)
            report(len(part[0].clock))
        yield _put_together(parts, len(entrants))


def _put_together(
    parts: Sequence[tuple[Outcome, np.ndarray | None]], policies: int
) -> tuple[list[Outcome], np.ndarray]:
    """Joins the batches of a cell, policy by policy."""
    outcomes = [outcome for outcome, _ in parts]
    lengths = [lengths for _, lengths in parts if lengths is not None]
    by_policy = batched(outcomes, len(parts) // policies)
    whole = [Outcome(*map(np.concatenate, zip(*mine, strict=True))) for mine in by_policy]
    return whole, np.concatenate(lengths)


def _jobs(
    config: EvaluateConfig, cell: Cell, entrant: Entrant, workers: int, *, find_ways: bool
) -> list[_Job]:
    """Splits the levels of a cell into batches for one policy."""
    count, mine = len(cell.episodes), specialise(config, cell, entrant.path)
    size = min(BATCH, math.ceil(count / workers))
    rows = [slice(first, first + size) for first in range(0, count, size)]
    parts = [Level(*(field[part] for field in cell.levels)) for part in rows]
    return [_Job(mine, entrant.policy, cell.half, part, find_ways) for part in parts]


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
    """Prepares a process that judges."""
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


def _simulate(job: _Job) -> tuple[Outcome, np.ndarray | None]:
    judge = evaluate_judge.load(job.config, job.policy, job.half)
    outcome = engine_c.simulate(judge, split(job.levels))
    return outcome, ways(job.config, job.levels) if job.find_ways else None


def ways(config: EvaluateConfig, levels: Level) -> np.ndarray:
    """Finds the lengths of the shortest paths from starts to targets.

    Args:
      config: Settings with the radii of robots and targets.
      levels: [E].

    Returns:
      [E, R] m; inf where there is no path for any robot.
    """
    start, hull, reach = levels.start[..., :2], config.robot.hull_radius, config.task.target_radius
    return shortest_path.shortest(levels.side, start, levels.target, levels.obstacle, hull, reach)
