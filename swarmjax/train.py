"""`python -m swarmjax.train stage=... key=value`: trains a swarm, from the command line.

With no argument it trains the default curriculum. `--help` gives examples. JAX takes seconds to
load, so it is imported only when the settings are known to be sound.
"""

import sys
from collections.abc import Sequence

from swarmjax import command
from swarmjax.run.display import working
from swarmjax.run.errors import CheckpointError
from swarmjax.run.settings import TrainConfig, load_run
from swarmjax.run.signals import Stop


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    with Stop() as stop:
        with working("starting"):
            settings, auto = load_run(arguments)
            from swarmjax.run.execute import execute
        return execute(settings, stop, auto=auto)


if __name__ == "__main__":
    sys.exit(command.run("train", main, TrainConfig, (CheckpointError,)))
