"""Keeps the figures and the replay of a page up to date, in threads, while the page is open."""

import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from swarmjax.config import ConfigError
from swarmjax.policy import PolicyError
from swarmjax.report import page as report_page
from swarmjax.report import rows
from swarmjax.report.rows import History
from swarmjax.run.directory import METRICS, check_regular
from swarmjax.run.errors import CheckpointError
from swarmjax.watch import newest, status
from swarmjax.watch.config import WatchConfig
from swarmjax.watch.newest import Newest

LOOKED_AT_S = 15.0  # the page counts as open for this long after its last request
PAUSE_S = 0.5  # seconds between two checks of the directory
# Drawing takes at most this share of a core, so that it hardly slows down the run.
SHARE = 0.2


class DrawnFigures(NamedTuple):
    """Figures of a run.

    Attributes:
      version: increases with each drawing.
      history: the results that the figures show; None before the first update.
      figures: PNG files by name.
      trouble: why the newest drawing failed; empty if it did not.
    """

    version: int = 0
    history: History | None = None
    figures: Mapping[str, bytes] = {}
    trouble: str = ""


class Replayed(NamedTuple):
    """A replay.

    Attributes:
      version: increases with each replay.
      newest: the replay to show; None before there is one.
      trouble: why the newest replay failed; empty if it did not.
    """

    version: int = 0
    newest: Newest | None = None
    trouble: str = ""


class Views:
    """The figures and the replay of a run, which threads keep up to date."""

    def __init__(self, settings: WatchConfig) -> None:
        """Reads the run's config.

        Raises:
          ConfigError: if there is no valid config.
        """
        self.settings, self.run = settings, Path(settings.run)
        check_regular(self.run)
        self.trained = rows.read_config(self.run)
        self.drawn, self.replayed = DrawnFigures(), Replayed()
        self._asked = -LOOKED_AT_S
        self._seen: tuple[int, float] | None = None
        self._tried: int | None = None

    def follow(self) -> None:
        """Starts the threads that update figures and replay while the page is open."""
        for renew in (self.draw, self.replay):
            threading.Thread(target=self._keep, args=(renew,), daemon=True).start()

    def state(self) -> dict[str, Any]:
        """Returns the page's current content as plain data, and marks the page as open."""
        self._asked = time.monotonic()
        drawn, replayed = self.drawn, self.replayed
        now = status.read(self.run, self.trained)
        return {
            "state": now.state,
            "sentence": now.sentence,
            "facts": [] if drawn.history is None else report_page.facts(drawn.history),
            "figures": {"version": drawn.version, "names": list(drawn.figures)},
            "trouble": drawn.trouble,
            "replay": {
                "version": replayed.version,
                "sentence": "" if replayed.newest is None else replayed.newest.sentence,
                "trouble": replayed.trouble,
            },
        }

    def draw(self) -> float:
        """Redraws the figures if the run has logged more, and returns the seconds to rest."""
        version = _version(self.run / METRICS)
        if version is None or version == self._seen:
            return 0.0
        from swarmjax.report import figures  # Matplotlib takes a second

        began = time.perf_counter()
        try:
            check_regular(self.run)
            self.trained = rows.read_config(self.run)
            history = rows.read(self.run)
            self.drawn = DrawnFigures(self.drawn.version + 1, history, figures.png_files(history))
        except (ConfigError, OSError) as error:  # for example, the run was removed meanwhile
            self.drawn = self.drawn._replace(trouble=str(error))
        self._seen = version
        return (time.perf_counter() - began) * (1.0 - SHARE) / SHARE

    def replay(self) -> float:
        """Replays the newest policy if it is new, and returns the seconds to rest."""
        if self.drawn.history is None and not self.drawn.trouble:  # the history gives the stage
            return 0.0
        from swarmjax.run import checkpoint  # JAX takes seconds to import

        update = max(checkpoint.steps(self.run), default=None)
        if update is None or update == self._tried:
            return 0.0
        self._tried = update
        try:
            replay = newest.record(self.settings, self.drawn.history)
            self.replayed = Replayed(self.replayed.version + 1, replay)
        except (ConfigError, CheckpointError, PolicyError, OSError) as error:
            self.replayed = self.replayed._replace(trouble=str(error))
        return self.settings.seconds

    def _keep(self, renew: Callable[[], float]) -> None:
        """Keeps updating forever, while the page is open."""
        while True:
            rest = 0.0
            if time.monotonic() - self._asked < LOOKED_AT_S:
                try:
                    rest = renew()
                except Exception as error:  # unforeseen; the page must go on
                    sys.stderr.write(f"swarmjax.watch: {type(error).__name__}: {error}\n")
                    rest = LOOKED_AT_S
            time.sleep(PAUSE_S + rest)


def _version(path: Path) -> tuple[int, float] | None:
    """Returns a file's size and time, to detect changes; None if it is missing or empty."""
    try:
        file = path.stat()
    except OSError:
        return None
    return (file.st_size, file.st_mtime) if file.st_size else None
