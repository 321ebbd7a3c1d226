"""Draws the page that follows a run: the run's status, and its report.

The figures are drawn again when the run has logged more.
"""

import threading
import time
from pathlib import Path
from typing import Any

from swarmjax import command
from swarmjax.config import ConfigError
from swarmjax.pages import builder
from swarmjax.report import page as report_page
from swarmjax.report import rows
from swarmjax.report.rows import History
from swarmjax.run.directory import METRICS
from swarmjax.watch import status

# Drawing takes at most this share of a core, so that it hardly slows down the run.
SHARE = 0.2
_TEMPLATE = "watch/watch.html"


class LivePage:
    """The page of a run.

    Attributes:
      run: The run directory.
      trained: The run's config.
      history: The results that the figures show; None before the first update.
      figures: PNG files by name.
      trouble: Why the newest drawing failed; empty if it succeeded.
    """

    def __init__(self, run: Path) -> None:
        """Reads the run's config.

        Raises:
          ConfigError: If the run has no valid config.
        """
        self.run, self.trained = run, rows.read_config(run)
        self.history: History | None = None
        self.figures: dict[str, bytes] = {}
        self.trouble = ""
        self._drawn = 0  # bytes of METRICS that the figures show; a run only adds to this file
        self._rests_until = 0.0
        self._lock = threading.Lock()  # two browsers may ask at once

    def html(self) -> str:
        """Returns the page as it is now."""
        with self._lock:
            self._draw()
            state, sentence = status.read(self.run, self.trained, self.history)
            about: dict[str, Any] = {"state": state, "sentence": sentence, "trouble": self.trouble}
            about |= {"title": f"Watching {self.run}", "has_trained": self.history is not None}
            if self.history is None:
                return builder.render(_TEMPLATE, styles=report_page.STYLES, **about)
            about |= {"template": _TEMPLATE, "replay": report_page.replay(self.run)}
            about["command"] = command.line("watch", f"run={self.run}")
            return report_page.page(history=self.history, figures=self.figures, **about)

    def _draw(self) -> None:
        """Draws the figures if the run has logged more, but not too soon after the last drawing."""
        metrics, began = self.run / METRICS, time.monotonic()
        written = metrics.stat().st_size if metrics.exists() else 0
        if written in (0, self._drawn) or began < self._rests_until:
            return
        from swarmjax.report import figures  # Matplotlib takes a second

        try:
            self.history = rows.read(self.run)
            self.figures, self.trouble = figures.png_files(self.history), ""
        except (ConfigError, OSError) as error:  # for example, the run was removed meanwhile
            self.trouble = str(error)
        now = time.monotonic()
        self._drawn, self._rests_until = written, now + (now - began) * (1.0 - SHARE) / SHARE
