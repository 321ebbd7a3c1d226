"""`python -m swarmjax.train stage=... key=value`: trains a swarm, from the command line.

With no argument it trains the default curriculum. `--help` gives examples. JAX takes seconds to
load, so it is imported only when the settings are known to be sound.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from swarmjax import command
from swarmjax.run.display import working
from swarmjax.run.errors import CheckpointError
from swarmjax.run.settings import TrainConfig, load_resume, load_train, read_config

_AUTO = "auto"  # what `arenas` may be instead of a number


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    with working("starting"):
        settings, auto = _settings(arguments)
        from swarmjax.run.execute import execute
    return execute(settings, auto=auto)


def _settings(arguments: Sequence[str]) -> tuple[TrainConfig, bool]:
    """Reads the command line; with `resume=` the stored config and what may be changed of it.

    Returns:
      The config, and whether its number of arenas is still to be chosen.
    """
    given = {key: value for key, _, value in (word.partition("=") for word in arguments)}
    resumed = given.get("resume", "null").strip("'\"")
    if resumed in ("", "null"):
        auto = given.get("arenas", "").strip("'\"") == _AUTO
        return load_train(arguments, auto=auto), auto
    settings = load_resume(read_config(Path(resumed)), arguments)
    kept = given.get("run.dir", "null") in ("", "null") or settings.run.dir is None
    directory = settings.resume if kept else settings.run.dir
    return replace(settings, run=replace(settings.run, dir=directory)), False


if __name__ == "__main__":
    sys.exit(command.run("train", main, TrainConfig, (CheckpointError,)))
