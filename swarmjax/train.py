"""`python -m swarmjax.train stage=... key=value`: trains a swarm, from the command line.

Without arguments it trains the default curriculum. `--help` shows examples. JAX takes seconds to
load, so it is imported only after the settings have passed their checks. Signals are handled even
before the settings are checked.

Examples:
  # the default curriculum, into a new folder of runs/
  python -m swarmjax.train
  # one stage, on wheels
  python -m swarmjax.train stage=s6 robot=wheeled budget=8e6 arenas=512
  # four seeds at once, into a folder of your choice
  python -m swarmjax.train run.dir=runs/first seeds=4
  # a curriculum of three stages
  python -m swarmjax.train stage=curriculum 'stage.sequence=[s1,s3,s6]'
  # start from a trained run, on realistic robots
  python -m swarmjax.train init_from=runs/first realism=real
  # go on with a run that was stopped
  python -m swarmjax.train resume=runs/first
  # compile and print the memory that the run needs
  python -m swarmjax.train stage=s6 run.dry=true
"""

import sys
from collections.abc import Sequence
from functools import partial

from swarmjax.run import heap, rank
from swarmjax.run.signals import Stop


def main(arguments: Sequence[str]) -> int:
    """Runs the command and returns its exit code."""
    with Stop() as stop:
        return _train(arguments, stop)


def _train(arguments: Sequence[str], stop: Stop) -> int:
    from swarmjax.run.display import working

    with working("starting"):
        from swarmjax.run.load_settings import load_run

        settings = load_run(arguments)
        if settings.run.distributed and not rank.is_child():
            return rank.supervise(stop)
        from swarmjax.run.execute import execute
    return execute(settings, stop)


def _command() -> int:
    """Runs the command on the arguments of the command line."""
    heap.share()
    if rank.is_child():
        rank.begin()
    with Stop(patient=rank.is_child(), last=True) as stop:
        from swarmjax import command
        from swarmjax.run.errors import CheckpointError
        from swarmjax.run.settings import TrainConfig

        train = partial(_train, stop=stop)
        return command.run("train", train, TrainConfig, (CheckpointError,))


if __name__ == "__main__":
    sys.exit(_command())
