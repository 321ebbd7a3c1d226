"""Keeps the figures and the replay of a page up to date, in a thread, while the page is open."""

import sys
import threading
import time
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError
from swarmjax.policy import PolicyError
from swarmjax.report import page as report_page
from swarmjax.report import rows
from swarmjax.report.rows import History
from swarmjax.run.directory import METRICS
from swarmjax.run.errors import CheckpointError
from swarmjax.watch import newest, status
from swarmjax.watch.config import WatchConfig

LOOKED_AT_S = 15.0  # the page counts as open for this long after its last request
PAUSE_S = 0.5  # seconds between two checks of the directory
REPLAY_S = 30.0  # shortest time between two replays
# Drawing takes at most this share of a core, so that it hardly slows down the run.
SHARE = 0.2


class Views:
    """The figures and the replay of a run.

    Attributes:
      settings: settings of the page.
      run: the run directory.
      trained: the run's config.
      history: the results that the figures show; None before the first update.
      figures: PNG files by name.
      drawing: version of the figures, and why the newest drawing failed, if it did.
      replay: the HTML page of the newest replay; empty before there is one.
      replaying: version of the replay, what it shows, and why the newest one failed, if it did.
    """

    def __init__(self, settings: WatchConfig) -> None:
        """Reads the run's config.

        Raises:
          ConfigError: if there is no valid config.
        """
        self.settings, self.run = settings, Path(settings.run)
        self.trained = rows.read_config(self.run)
        self.history: History | None = None
        self.figures: dict[str, bytes] = {}
        self.drawing: dict[str, Any] = {"version": 0, "trouble": ""}
        self.replay = ""
        self.replaying: dict[str, Any] = {"version": 0, "sentence": "", "trouble": ""}
        self._asked = -LOOKED_AT_S
        self._drawn: tuple[int, float] | None = None
        self._replayed: int | None = None

    def follow(self) -> None:
        """Starts the thread that updates figures and replay while the page is open."""
        threading.Thread(target=self._keep, daemon=True).start()

    def state(self) -> dict[str, Any]:
        """Returns the page's current content as plain data, and marks the page as open."""
        self._asked = time.monotonic()
        now = status.read(self.run, self.trained, self.history)
        return {
            **now._asdict(),
            "facts": [] if self.history is None else report_page.facts(self.history),
            "figures": {"version": self.drawing["version"], "names": list(self.figures)},
            "trouble": self.drawing["trouble"],
            "replay": self.replaying,
        }

    def draw(self) -> float:
        """Redraws the figures if the run has logged more, and returns the seconds to rest."""
        version = _version(self.run / METRICS)
        if version is None or version == self._drawn:
            return 0.0
        from swarmjax.report import figures  # Matplotlib takes a second

        began = time.perf_counter()
        try:
            self.history = rows.read(self.run)
            self.figures = figures.png_files(self.history)
            self.drawing = {"version": self.drawing["version"] + 1, "trouble": ""}
        except (ConfigError, OSError) as error:  # for example, the run was removed meanwhile
            self.drawing |= {"trouble": str(error)}
        self._drawn = version
        return (time.perf_counter() - began) * (1.0 - SHARE) / SHARE

    def record(self) -> float:
        """Replays the newest policy if it is new, and returns the seconds to rest."""
        from swarmjax.run import checkpoint  # JAX takes seconds to import

        update = max(checkpoint.steps(self.run), default=None)
        if update is None or update == self._replayed:
            return 0.0
        self._replayed = update
        try:
            sentence, self.replay = newest.record(self.settings, self.history)
            version = self.replaying["version"] + 1
            self.replaying = {"version": version, "sentence": sentence, "trouble": ""}
        except (ConfigError, CheckpointError, PolicyError, OSError) as error:
            self.replaying |= {"trouble": str(error)}
        return REPLAY_S

    def _keep(self) -> None:
        """Keeps updating forever, while the page is open."""
        ready = {self.draw: 0.0, self.record: 0.0}
        while True:
            time.sleep(PAUSE_S)
            for renew, due in ready.items():
                now = time.monotonic()
                if now - self._asked > LOOKED_AT_S or now < due:
                    continue
                try:
                    rest = renew()
                except Exception as error:  # unforeseen; the page must go on
                    sys.stderr.write(f"swarmjax.watch: {type(error).__name__}: {error}\n")
                    rest = LOOKED_AT_S
                ready[renew] = time.monotonic() + rest


def _version(path: Path) -> tuple[int, float] | None:
    """Returns a file's size and time, to detect changes; None if it is missing or empty."""
    try:
        file = path.stat()
    except OSError:
        return None
    return (file.st_size, file.st_mtime) if file.st_size else None
