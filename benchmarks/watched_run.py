"""A `swarmjax.train` in a process of its own, watched from the outside with a clock."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError
from swarmjax.exit_codes import INTERRUPTED
from swarmjax.report import rows as report_rows
from swarmjax.run.recorder import METRICS

# Of a run's summary, what a line about it says of where it was made.
MADE_WITH = ("device", "versions", "commit")
_PAUSE = 0.01  # s between two looks at what the run has written
# Many containers forbid Python to keep what it compiles, which makes every start seconds longer.
_AS_EVERYWHERE = {"PYTHONDONTWRITEBYTECODE": ""}


class Watched:
    """A training run.

    Attributes:
      directory: of the run.
      seconds: from the command to its end, once it has ended.
    """

    def __init__(
        self, words: Sequence[str], directory: Path, environment: Mapping[str, str]
    ) -> None:
        """Starts it.

        Args:
          words: of `swarmjax.train`, `key=value`.
          directory: for the run, not there yet.
          environment: variables that it is given besides those of this process.
        """
        self.directory, self.seconds, self._asked = directory, 0.0, False
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115  # `_finish` closes it
        self._began = time.perf_counter()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "swarmjax.train", *words, f"run.dir={directory}"],
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env={**os.environ, **_AS_EVERYWHERE, **environment},
        )

    def rows(self) -> Iterator[tuple[float, dict[str, Any]]]:
        """Yields the rows of its metrics, each with the seconds since the command, to its end.

        Raises:
          ConfigError: if it ends with an error, which the sentence has.
        """
        path, at = self.directory / METRICS, 0
        while True:
            ended = self._process.poll() is not None
            whole = path.read_text()[at:].rpartition("\n")[0] if path.exists() else ""
            now = time.perf_counter() - self._began
            at += len(whole) + 1 if whole else 0
            yield from ((now, json.loads(text)) for text in whole.splitlines())
            if ended:
                break
            time.sleep(_PAUSE)
        self._finish()

    def stop(self) -> None:
        """Asks it to save and stop; `rows` goes on until it has. A second time would end it."""
        if self._process.poll() is None and not self._asked:
            self._process.send_signal(signal.SIGINT)
            self._asked = True

    def summary(self) -> dict[str, Any]:
        """What it came to. Device, versions and commit are in it: this process takes no card."""
        return report_rows.read_object(self.directory / report_rows.SUMMARY)

    def _finish(self) -> None:
        self.seconds = time.perf_counter() - self._began
        self._errors.seek(0)
        words = [line.strip() for line in self._errors if line.strip()]
        self._errors.close()
        if self._process.returncode not in (0, INTERRUPTED):
            raise ConfigError(words[-1] if words else f"{self.directory} was not trained.")
