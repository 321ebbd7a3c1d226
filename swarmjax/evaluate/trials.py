"""Runs evaluations: cells times policies, split over processes, or by the engine that trains."""

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context, parent_process
from typing import NamedTuple

import numpy as np

from swarmjax import policy_file, provenance
from swarmjax.config import build, files
from swarmjax.evaluate import engine_c, measures, shortest_path
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.cells import Cell, split
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.measures import Outcome
from swarmjax.policy import Policy
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.level import Level

BATCH = 64  # arenas that share NumPy's cost per call; more gain little


class Entrant(NamedTuple):
    """A policy that is judged, and the path of its file."""

    path: str
    policy: Policy


class Trial(NamedTuple):
    """What became of policies on the levels of a cell.

    Attributes:
        cell: The levels, E of them.
        shortest: [E, R] lengths of the shortest ways, m; inf where a target cannot be reached.
        found: [P, E] of each measure that the engine tells.
        arrival: [P, E, R] when robots arrived, s; inf if they did not.
    """

    cell: Cell
    shortest: np.ndarray
    found: dict[str, np.ndarray]
    arrival: np.ndarray


class _Job(NamedTuple):
    """Levels that one process runs by one policy, and whether it also finds their ways."""

    config: EvaluateConfig
    policy: Policy
    half: np.ndarray
    levels: Level
    find_ways: bool


def read_policies(files: Sequence[str], extensions: str | None = None) -> list[Entrant]:
    """Reads policy files.

    Args:
        files: Their paths.
        extensions: As the key of that name.

    Raises:
        PolicyError: If one of them is unsound.
    """
    return [Entrant(file, policy_file.read(file, extensions)) for file in files]


def run(
    config: EvaluateConfig,
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None] = lambda _: None,
) -> list[Trial]:
    """Judges policies on cells.

    Args:
        config: Of the evaluation.
        cells: Whose levels they are.
        entrants: The policies.
        report: Told how many more episodes are over, now and then.

    Returns:
        One for each cell.

    Raises:
        PolicyError: If a policy does not fit a cell.
        ConfigError: If the physics breaks down.
    """
    for cell in cells:
        for each in entrants:
            evaluate_judge.check_policy(config, cell.stage, *each)
    play = _by_mjx if config.engine == "mjx" else _by_c
    results = play(config, cells, entrants, report)
    return [_try(config, cell, *result) for cell, result in zip(cells, results, strict=True)]


def specialise(config: EvaluateConfig, cell: Cell, path: str | None = None) -> EvaluateConfig:
    """Makes the configuration of one cell, and of one policy.

    Args:
        config: Of the evaluation.
        cell: Its stage, shape, seed and realism are taken, the last if it has one.
        path: Of the policy.

    Returns:
        The configuration.
    """
    realism = config.realism
    if cell.realism is not None:
        realism = build(RealismConfig, files.read_preset("realism", cell.realism))
    return replace(
        config,
        policy=path or config.policy,
        compare=None if path else config.compare,
        suite=None,
        stage=cell.stage,
        shape=cell.shape,
        realism=realism,
        seed=cell.seed,
        episodes=len(cell.episodes),
    )


def _try(
    config: EvaluateConfig, cell: Cell, outcomes: Sequence[Outcome], shortest: np.ndarray
) -> Trial:
    """Puts what policies came to on a cell together."""
    second = config.task.control_step
    rows = [measures.per_level(each, second, config.steps, shortest) for each in outcomes]
    arrival = [np.where(each.arrived, each.arrival * second, np.inf) for each in outcomes]
    found = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return Trial(cell, shortest, found, np.stack(arrival))


def _by_mjx(
    config: EvaluateConfig,
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None],
) -> Iterator[tuple[list[Outcome], np.ndarray]]:
    """Runs each cell at once by the engine that trains."""
    from swarmjax.evaluate import engine_mjx
    from swarmjax.run import compile_cache  # those that need JAX

    for cell in cells:
        mine, outcomes = specialise(config, cell, entrants[0].path), []
        with compile_cache.use(compile_cache.AUTO):
            world = engine_mjx.load(mine, cell.largest_half, len(cell.episodes))
            for each in entrants:
                found = engine_mjx.play(
                    world,
                    cell.levels,
                    each.policy,
                    config.steps,
                    sampled=config.action == "sampled",
                )
                outcomes.append(found)
                report(len(cell.episodes))
        yield outcomes, ways(mine, cell.levels)


def _by_c(
    config: EvaluateConfig,
    cells: Sequence[Cell],
    entrants: Sequence[Entrant],
    report: Callable[[int], None],
) -> Iterator[tuple[list[Outcome], np.ndarray]]:
    """Runs all episodes in batches, by as many processes as are useful."""
    workers = config.workers or provenance.cores()
    jobs = [
        [_jobs(config, cell, each, workers, find_ways=not i) for i, each in enumerate(entrants)]
        for cell in cells
    ]
    flat = [job for by_policy in jobs for mine in by_policy for job in mine]
    done = work(_simulate, flat, min(workers, len(flat)))
    for by_policy in jobs:
        outcomes, lengths = [], []
        for mine in by_policy:
            parts = []
            for _ in mine:
                outcome, found = next(done)
                parts.append(outcome)
                lengths += [] if found is None else [found]
                report(len(outcome.clock))
            outcomes.append(Outcome(*map(np.concatenate, zip(*parts, strict=True))))
        yield outcomes, np.concatenate(lengths)


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
    """Does jobs, yielding what comes of them in their order.

    Args:
        function: Of a module, so that other processes find it.
        jobs: What it takes.
        workers: Processes; with one there is no other than this.
    """
    if workers == 1:
        yield from map(function, jobs)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin_worker) as pool:
        yield from pool.map(function, jobs)


def _begin_worker() -> None:
    """Prepares a process that judges."""
    # Ctrl-C ends it at once and without a word; its parent says what happened.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Pieces of extensions run on JAX; on a GPU each process would take most of its memory.
    os.environ["JAX_PLATFORMS"] = "cpu"
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Ends this process when its parent dies, which would otherwise leave it running."""
    parent = parent_process()
    assert parent is not None  # this one was spawned
    parent.join()
    os._exit(1)


def _simulate(job: _Job) -> tuple[Outcome, np.ndarray | None]:
    judge = evaluate_judge.load(job.config, job.policy, job.half)
    outcome = engine_c.simulate(judge, split(job.levels))
    return outcome, ways(job.config, job.levels) if job.find_ways else None


def ways(config: EvaluateConfig, levels: Level) -> np.ndarray:
    """Finds the lengths of the shortest ways from starts to targets.

    Args:
        config: Read for the radii of robots and targets.
        levels: [E].

    Returns:
        [E, R] m; inf where there is no way, whoever drives.
    """
    start, hull, reach = levels.start[..., :2], config.robot.hull_radius, config.task.target_radius
    return shortest_path.shortest(levels.side, start, levels.target, levels.obstacle, hull, reach)
