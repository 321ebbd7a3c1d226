"""`python -m swarmjax.train stage=... key=value`: trains a swarm, from the command line.

With no argument it trains the default curriculum. `--help` lists every key.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax

from swarmjax import command
from swarmjax.run import compile_cache, memory
from swarmjax.run.checkpoint import CheckpointError
from swarmjax.run.display import Display
from swarmjax.run.lifecycle import carry_out, dry_run, find_run
from swarmjax.run.policy_export import POLICY, seed_path
from swarmjax.run.settings import TrainConfig, load_resume, load_train, read_config
from swarmjax.run.trainer import Stop, Tally, TrainingError, measure

FAILED = 1


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings, auto = _settings(arguments)
    with compile_cache.use(settings.run.compile_cache):
        if auto:
            available = None if jax.default_backend() == "cpu" else memory.limit()
            with memory.refusal(settings):
                settings, why = memory.fill(settings, measure, available)
            sys.stdout.write(f"{why}\n")
        with memory.refusal(settings):
            return _run(settings)


def _run(settings: TrainConfig) -> int:
    """Does what the config says; returns the exit code."""
    if settings.run.dry:
        return dry_run(settings)
    run = find_run(settings)
    with Stop() as stop, Display(settings.updates) as display:
        try:
            tally = carry_out(settings, run, stop, display)
        except TrainingError as error:
            display.say(f"swarmjax.train: error: {error} What was saved before is in {run}.")
            return FAILED
    sys.stdout.write(_closing(run, settings, tally) + "\n")
    return command.INTERRUPTED if stop.asked else 0


def _settings(arguments: Sequence[str]) -> tuple[TrainConfig, bool]:
    """Reads the command line; with `resume=` the stored config and what may be changed of it.

    Returns:
      The config, and whether its number of arenas is still to be chosen.
    """
    given = {key: value for key, _, value in (word.partition("=") for word in arguments)}
    resumed = given.get("resume", "null").strip("'\"")
    if resumed in ("", "null"):
        auto = given.get("arenas", "").strip("'\"") == memory.AUTO
        return load_train(arguments, auto=auto), auto
    settings = load_resume(read_config(Path(resumed)), arguments)
    kept = given.get("run.dir", "null") in ("", "null") or settings.run.dir is None
    directory = settings.resume if kept else settings.run.dir
    return replace(settings, run=replace(settings.run, dir=directory)), False


def _closing(run: Path, settings: TrainConfig, tally: Tally) -> str:
    """Says what to do next."""
    if tally.update < settings.updates:
        return (
            f"stopped after update {tally.update:,} of {settings.updates:,}, saved; go on with: "
            f"python -m swarmjax.train resume={run}"
        )
    policy = seed_path(run / POLICY, settings, settings.seed)
    stage = settings.stage[-1].name
    what = "the policy" if settings.seeds == 1 else f"each of {settings.seeds} policies"
    return f"done; judge {what} with: python -m swarmjax.evaluate policy={policy} stage={stage}"


if __name__ == "__main__":
    sys.exit(command.run("train", main, TrainConfig, (CheckpointError,)))
