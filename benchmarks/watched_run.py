"""Runs `swarmjax.train` in its own process and times it from outside."""

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

# Entries of a run's summary that give the device, versions and commit.
MADE_WITH = ("device", "versions", "commit")
_PAUSE = 0.01  # s between two reads of the run's metrics
# Many containers prevent Python from saving its bytecode, so every start takes seconds longer. An
# empty value lets Python save bytecode.
_AS_EVERYWHERE = {"PYTHONDONTWRITEBYTECODE": ""}


class Watched:
    """A training run in its own process.

    Attributes:
      directory: directory of the run.
      seconds: seconds from the start of the command to its end; valid once the run has ended.
    """

    def __init__(
        self, words: Sequence[str], directory: Path, environment: Mapping[str, str]
    ) -> None:
        """Starts the run.

        Args:
          words: `key=value` arguments for `swarmjax.train`.
          directory: directory for the run; it must not exist.
          environment: environment variables in addition to those of this process.
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
        """Yields each row of the metrics and the seconds since the run started, until the run ends.

        Raises:
          ConfigError: if the run ends with an error; the message is the run's last error line.
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
        """Asks the run to save and stop, but only once, since a second signal would kill it.

        `rows` continues until the run has stopped.
        """
        if self._process.poll() is None and not self._asked:
            self._process.send_signal(signal.SIGINT)
            self._asked = True

    def summary(self) -> dict[str, Any]:
        """Reads the run's summary, including device, versions and commit, without using a GPU."""
        return report_rows.read_object(self.directory / report_rows.SUMMARY)

    def _finish(self) -> None:
        self.seconds = time.perf_counter() - self._began
        self._errors.seek(0)
        words = [line.strip() for line in self._errors if line.strip()]
        self._errors.close()
        if self._process.returncode not in (0, INTERRUPTED):
            raise ConfigError(words[-1] if words else f"{self.directory} was not trained.")
