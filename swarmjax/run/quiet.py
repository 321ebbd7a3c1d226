"""Trains without a terminal, for Python programs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError
from swarmjax.run import compile_cache, memory
from swarmjax.run.display import Display, Row
from swarmjax.run.lifecycle import carry_out, find_run
from swarmjax.run.loggers import Guarded, Logger
from swarmjax.run.policy_export import POLICY, seed_path
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop


class _Listener(Display):
    """Prints nothing, and passes on the rows of each call."""

    def __init__(
        self,
        updates: int,
        on_update: Callable[[dict[str, Any]], object],
        stop: Stop,
        loggers: Sequence[Guarded],
    ) -> None:
        super().__init__(updates)
        self._on_update, self._stop, self._loggers = on_update, stop, loggers

    def say(self, sentence: str) -> None:
        """Prints nothing."""

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Shows nothing."""
        yield

    def hear(self, rows: Sequence[Row], speeds: Row) -> None:
        """Passes each row on, and asks the run to stop if the callback returns True."""
        for logger in self._loggers:
            logger.write([dict(row) for row in rows], dict(speeds))
        for row in rows:
            if self._on_update(dict(row)) is True:
                self._stop.signalled = True

    def show(self, summary: Row, speeds: Row, seconds_left: float) -> None:
        """Shows nothing."""


def train(
    settings: TrainConfig,
    on_update: Callable[[dict[str, Any]], object],
    listen: Callable[[Stop], AbstractContextManager[object]],
    *,
    loggers: Sequence[Logger] = (),
) -> tuple[Path, list[Path]]:
    """Trains a run.

    Args:
      settings: the config.
      on_update: called with each row of `metrics.jsonl`; it returns True to stop the run.
      listen: makes the context manager for training, for example one that notices signals, as
        `Stop` does.
      loggers: further loggers, which receive the rows too and are closed when the run is written.

    Returns:
      The run directory, and the policy files of its seeds.

    Raises:
      ConfigError, CheckpointError, TrainingError: as `lifecycle.carry_out`.
    """
    if settings.run.dry:
        raise ConfigError("run.dry is true, but works only on the command line: leave it out.")
    with ExitStack() as told, compile_cache.use():
        guarded = [told.enter_context(closing(Guarded(each))) for each in loggers]
        with memory.refusal(settings):
            run, stop = find_run(settings), Stop()
            with listen(stop), _Listener(settings.updates, on_update, stop, guarded) as display:
                carry_out(settings, run, stop, display)
    return run, [seed_path(run / POLICY, settings, seed) for seed in settings.numbers]
