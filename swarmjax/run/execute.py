"""Runs checked settings and returns an exit code: caches, memory, and the closing lines."""

import math
import sys
from pathlib import Path

from swarmjax import command, words
from swarmjax.config import ConfigError
from swarmjax.exit_codes import FAILED, INTERRUPTED, REQUEUE, USER_ERROR
from swarmjax.run import checkpoint, compile_cache, directory, hosts, memory
from swarmjax.run.display import Display, measured, spread
from swarmjax.run.errors import CheckpointError, LostPeerError, TrainingError
from swarmjax.run.lifecycle import carry_out, dry_run, find_run
from swarmjax.run.policy_export import POLICY, seed_path
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop, StoppedError
from swarmjax.run.trainer import Tally


def execute(settings: TrainConfig, stop: Stop) -> int:
    """Trains a run.

    Args:
      settings: the run's config.
      stop: notices signals.

    Returns:
      The exit code of the command.
    """
    hosts.join(settings)
    with compile_cache.use():
        try:
            with hosts.lost_peers(), memory.refusal(settings):
                return _run(settings, stop)
        except LostPeerError as error:
            sys.stderr.write(f"swarmjax.train: {error} Go on with resume=auto.\n")
            return hosts.leave(REQUEUE)
        except (ConfigError, CheckpointError) as error:
            if hosts.count() == 1:
                raise
            sys.stderr.write(f"swarmjax.train: error: {error}\n")
            return hosts.leave(USER_ERROR)


def _run(settings: TrainConfig, stop: Stop) -> int:
    """Trains, or with `run.dry` only describes the run, and returns the exit code."""
    try:
        if settings.run.dry:
            with Display(settings.updates) as display:
                return dry_run(settings, stop, display)
        found = find_run(settings) if hosts.is_first() else Path()
        with hosts.own_directory(found) as run:
            return _train(run, settings, stop)
    except StoppedError:
        sys.stdout.write(
            "stopped before the first update: nothing was trained, and nothing is lost\n"
        )
        return stop.code or INTERRUPTED


def _train(run: Path, settings: TrainConfig, stop: Stop) -> int:
    try:
        with Display(settings.updates) as display:
            tally = carry_out(settings, run, stop, display)
    except TrainingError as error:
        can_go_on = (run / directory.CONFIG).exists() and checkpoint.steps(run)
        kept = f" What was saved before is in {run}." if can_go_on else ""
        sys.stderr.write(f"swarmjax.train: error: {error}{kept}\n")
        return FAILED
    sys.stdout.write(f"{_success(settings, tally)}\n{_closing(run, settings, tally)}\n")
    return stop.code or 0


def _success(settings: TrainConfig, tally: Tally) -> str:
    """Describes how good the swarm is on the furthest stage that has been measured."""
    last = settings.stage[-1].name
    for stage in reversed(settings.stage):
        found = spread([of_seed.get(stage.name) for of_seed in tally.targets_reached.values()])
        if found is not None:
            more = "" if stage.name == last else f"; {last} was not measured yet"
            steps = settings.task.step_limit
            seconds = steps * settings.task.control_step
            return (
                f"targets reached on {stage.name}: {measured(found)} within {steps} control steps "
                f"({seconds:.3g} s), in a whole cohort of episodes{more}"
            )
    updates = words.count(
        math.ceil(settings.task.step_limit / settings.algo.rollout_length), "update"
    )
    return (
        f"targets reached: not measured yet, since no whole cohort ended: the episodes of a cohort "
        f"begin within one step limit ({updates}) and end within the next"
    )


def _closing(run: Path, settings: TrainConfig, tally: Tally) -> str:
    """Describes what to do next."""
    code = [] if settings.extensions is None else [f"extensions={settings.extensions}"]
    if tally.update < settings.updates:
        saved = max(checkpoint.steps(run), default=0)
        how = "saved" if saved == tally.update else f"saved at update {saved:,}, the last sound one"
        return (
            f"stopped after update {tally.update:,} of {settings.updates:,}, {how}; go on with: "
            f"{command.line('train', f'resume={run}', *code)}"
        )
    policy = seed_path(run / POLICY, settings, settings.seed)
    arguments = [f"policy={policy}", *code]
    what = "the policy" if settings.seeds == 1 else f"each of {settings.seeds} policies"
    return f"done; judge {what} with: {command.line('evaluate', *arguments)}"
