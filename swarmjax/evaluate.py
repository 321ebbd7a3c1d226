"""`python -m swarmjax.evaluate policy=FILE stage=s6`: judges a policy in MuJoCo's C engine.

`evaluate_c.py` runs the episodes; here they are split over processes, summed up and shown.
"""

import json
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from swarmjax import command, config, evaluate_c, policy, provenance
from swarmjax.config import ConfigError, EvaluateConfig
from swarmjax.evaluate_c import Outcome
from swarmjax.policy import Policy
from swarmjax.sim import gaps

BATCH = 64  # arenas that share NumPy's cost per call; more gain little


def evaluate(
    config: EvaluateConfig, trained: Policy, report: Callable[[int], None] = lambda _: None
) -> dict[str, Any]:
    """Judges a policy.

    Args:
        config: Of the evaluation.
        trained: The policy.
        report: Told how many more episodes are over, now and then.

    Returns:
        The result, plain data for JSON; `docs/interface.md` lists it.

    Raises:
        PolicyError: If the policy does not fit the stage.
        ConfigError: If the physics breaks down.
    """
    outcome = outcomes(config, trained, report)
    return summarize(outcome, config.task.control_step) | {
        "episodes": config.episodes,
        "engine": config.engine,
        "robot": config.robot.body,
        "realism": config.realism.name,
        "stage": config.stage.name,
        "steps": config.steps,
        "seed": config.seed,
        "policy": config.policy,
        "policy_digest": trained.digest,
        "versions": provenance.versions(),
    }


def outcomes(
    config: EvaluateConfig, trained: Policy, report: Callable[[int], None] = lambda _: None
) -> Outcome:
    """Runs all episodes of an evaluation.

    Args:
        config: Of the evaluation.
        trained: The policy.
        report: Told how many more episodes are over, now and then.

    Returns:
        What they came to, in their order.

    Raises:
        PolicyError: If the policy does not fit the stage.
        ConfigError: If the physics breaks down.
    """
    parts = []
    for part in _simulate_all(config, trained):
        parts.append(part)
        report(len(part.clock))
    return Outcome(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def _simulate_all(config: EvaluateConfig, trained: Policy) -> Iterator[Outcome]:
    """Runs all episodes in batches, by as many processes as are useful."""
    workers = config.workers or provenance.cores()
    size = min(BATCH, math.ceil(config.episodes / workers))
    batches = [
        range(first, min(first + size, config.episodes))
        for first in range(0, config.episodes, size)
    ]
    workers = min(workers, len(batches))
    work = partial(_simulate_batch, config, trained)
    if workers == 1:
        yield from map(work, batches)
        return
    # Ctrl-C ends the others at once and without a word; this process says what happened.
    end = (signal.SIGINT, signal.SIG_DFL)
    with ProcessPoolExecutor(workers, get_context("spawn"), signal.signal, end) as pool:
        yield from pool.map(work, batches)


def _simulate_batch(config: EvaluateConfig, trained: Policy, episodes: range) -> Outcome:
    return evaluate_c.simulate(evaluate_c.load(config, trained), episodes)


def summarize(outcome: Outcome, control_step: float) -> dict[str, Any]:
    """Sums episodes up.

    Args:
        outcome: Of all episodes.
        control_step: s.

    Returns:
        Shares (0..1) of targets reached and of episodes in which all were, with the standard
        errors of these means over episodes (null for a single one); contacts a robot and episode;
        share of robot steps before arrival with anything in infrared range; mean times of an
        episode and of an arrival (s, null where none arrived).
    """
    level_by_level = per_level(outcome, control_step)
    reached, complete = level_by_level["targets_reached"], level_by_level["all_reached"]
    contacts = outcome.contacts.mean(axis=(0, 1))
    arrivals = outcome.arrival[outcome.arrived]
    return {
        "targets_reached": float(reached.mean()),
        "targets_reached_se": _standard_error(reached),
        "all_reached": float(complete.mean()),
        "all_reached_se": _standard_error(complete),
        "contacts_per_robot": float(contacts.sum()),
        "contacts_per_robot_by_kind": dict(zip(gaps.KINDS, contacts.tolist(), strict=True)),
        "ir_steps_share": float(outcome.sensed.sum() / outcome.moving.sum()),
        "episode_time_s": float(level_by_level["episode_time_s"].mean()),
        "arrival_time_s": float(arrivals.mean() * control_step) if len(arrivals) else None,
    }


def per_level(outcome: Outcome, control_step: float) -> dict[str, np.ndarray]:
    """What each episode came to.

    Args:
        outcome: Of all episodes.
        control_step: s.

    Returns:
        [A] each: share of targets reached, whether all were, contacts a robot, and time (s).
    """
    return {
        "targets_reached": outcome.arrived.mean(axis=-1),
        "all_reached": outcome.arrived.all(axis=-1).astype(float),
        "contacts_per_robot": outcome.contacts.sum(axis=-1).mean(axis=-1),
        "episode_time_s": outcome.clock * control_step,
    }


def _standard_error(values: np.ndarray) -> float | None:
    """Estimates the standard error of the mean of independent values; none for one alone."""
    if len(values) < 2:
        return None
    return float(np.std(values, ddof=1) / math.sqrt(len(values)))


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = config.load_evaluate(arguments)
    trained = policy.load(settings.policy)
    if settings.out is not None:
        _check_out(Path(settings.out))
    progress = Progress(console=Console(stderr=True), transient=True)
    progress.disable = not progress.console.is_terminal
    try:
        with progress:
            bar = progress.add_task("episodes", total=settings.episodes)
            result = evaluate(settings, trained, partial(progress.advance, bar))
    except KeyboardInterrupt:
        sys.stderr.write("swarmjax.evaluate: interrupted, nothing was written.\n")
        return command.INTERRUPTED
    if settings.out is not None:
        _write(Path(settings.out), result)
    _print(Console(), result)
    return 0


def _check_out(path: Path) -> None:
    """Makes the folder of the result, before there is one to lose."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error.strerror) from None
    if path.is_dir():
        raise _unwritable(path, "it is a folder")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise _unwritable(path, "permission denied")


def _write(path: Path, result: dict[str, Any]) -> None:
    try:
        path.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise _unwritable(path, error.strerror) from None


def _unwritable(path: Path, reason: str | None) -> ConfigError:
    return ConfigError(f"out is {path}, which cannot be written: {reason}.")


def _print(console: Console, result: dict[str, Any]) -> None:
    """Prints a table, plain where it is not for a terminal."""
    title = f"{result['policy']} on {result['stage']}, {result['episodes']:,} episodes"
    console.print(title, highlight=False, markup=False, soft_wrap=True)
    table = Table(box=box.SIMPLE if console.is_terminal else None, show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for row in _rows(result):
        table.add_row(*row)
    console.print(table)


def _rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    """Words of the table; shares with the 95 % interval of a normal mean, 1.96 standard errors."""
    kinds = result["contacts_per_robot_by_kind"]
    arrival = result["arrival_time_s"]
    return [
        ("targets reached", _share(result, "targets_reached")),
        ("all robots reached", _share(result, "all_reached")),
        ("contacts per robot", f"{result['contacts_per_robot']:.2f}"),
        *((f"  with {kind}", f"{contacts:.2f}") for kind, contacts in kinds.items()),
        ("steps with infrared", f"{100 * result['ir_steps_share']:.1f} %"),
        ("episode time", f"{result['episode_time_s']:.1f} s"),
        ("arrival time", "-" if arrival is None else f"{arrival:.1f} s"),
    ]


def _share(result: dict[str, Any], key: str) -> str:
    error = result[f"{key}_se"]
    interval = "" if error is None else f" ± {196 * error:.1f}"
    return f"{100 * result[key]:.1f}{interval} %"


if __name__ == "__main__":
    sys.exit(command.run("evaluate", main, EvaluateConfig))
