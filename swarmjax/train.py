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
"""

import contextlib
import gc
import sys
import threading
from collections.abc import Sequence

from swarmjax.exit_codes import FAILED, INTERRUPTED, REQUEUE, USER_ERROR
from swarmjax.run import heap
from swarmjax.run.signals import Stop, StoppedError


def main(arguments: Sequence[str]) -> int:
    """Runs the command and returns its exit code."""
    with Stop(last=__name__ == "__main__") as stop:
        from swarmjax.run.load_settings import load_run

        settings = load_run(arguments)
        if not settings.run.distributed:  # distributed processes must first find each other
            threading.Thread(target=_open_device, args=(settings.sim.impl,)).start()
        from swarmjax.run.display import Display
        from swarmjax.run.run import Run

        try:
            Run(settings, stop=stop, display=Display(), keep_traces=__name__ == "__main__").train()
        except Exception as error:
            return _failed(error, stop)
        return stop.code or 0


def _open_device(impl: str) -> None:
    """Opens a GPU for JAX and Warp while the main thread imports its modules. Opening takes 2 s."""
    with contextlib.suppress(Exception):  # the run meets the same error, and reports it
        import jax
        import numpy as np

        jax.block_until_ready(jax.device_put(np.zeros(1)))
        from swarmjax.sim import dispatch, engine

        if dispatch.resolve_impl(impl) == "warp":
            engine.start_warp()


def _failed(error: Exception, stop: Stop) -> int:
    """Describes the error that ended a run, and returns the exit code.

    Raises:
      Exception: an error of the user in a run of one process, or a bug.
    """
    from swarmjax.config import ConfigError
    from swarmjax.run import hosts
    from swarmjax.run.errors import CheckpointError, LostPeerError, TrainingError

    if isinstance(error, StoppedError):
        sys.stdout.write(f"{error}\n")
        return stop.code or INTERRUPTED
    codes = {LostPeerError: REQUEUE, TrainingError: FAILED}
    if hosts.count() > 1:
        codes |= {ConfigError: USER_ERROR, CheckpointError: USER_ERROR}
    if type(error) not in codes:
        raise error
    sys.stderr.write(f"swarmjax.train: error: {error}\n")
    code = codes[type(error)]
    return code if hosts.count() == 1 else hosts.leave(code)


if __name__ == "__main__":
    from swarmjax import command
    from swarmjax.run.errors import CheckpointError
    from swarmjax.run.settings import TrainConfig

    heap.share()
    # Imports and traces make many objects that stay in memory. Looking for garbage among them takes
    # 0.2 s of a start.
    gc.set_threshold(100_000)
    sys.exit(command.run("train", main, TrainConfig, (CheckpointError,)))
