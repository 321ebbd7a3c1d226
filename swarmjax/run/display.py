"""Shows a run while it trains, as plain lines."""

import contextlib
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from swarmjax import life, words

Row = Mapping[str, Any]


def figures(rows: Sequence[Row], names: Sequence[str]) -> dict[str, str]:
    """Formats the metrics that the display shows. `metrics.jsonl` has all metrics.

    The texts cover a cohort: all episodes that began within one step limit. The episodes that end
    in an update would be a biased sample, because short ones end first.

    Args:
      rows: rows of all seeds, as `recorder.rows` makes them, in order.
      names: names of the stages, in order.

    Returns:
      Texts by name, for the newest stage of each seed.
    """
    last = [row for row in rows if row["update"] == rows[-1]["update"]]
    newest = [names.index(row["stage"]) for row in last]
    ends = dict.fromkeys([names[min(newest)], names[max(newest)]])

    def cohort(column: str) -> str:
        return spread([row[column][stage] for row, stage in zip(last, newest, strict=True)])

    return {
        "stage": words.shorten(" to ".join(ends), 30),
        "targets reached": cohort("success_by_stage"),
        "all robots reached": cohort("complete_by_stage"),
    }


def spread(shares: Sequence[float | None]) -> str:
    """Formats a share, with its smallest and largest value over the seeds that measured it."""
    measured = [100 * share for share in shares if share is not None]
    if not measured:
        return "not measured yet"
    mean, low, high = sum(measured) / len(measured), min(measured), max(measured)
    return f"{mean:.1f} %" + (f" ({low:.0f} to {high:.0f})" if low < high else "")


class Display:
    """Prints what a run says, line by line."""

    def __init__(self, *, quiet: bool = False) -> None:
        """Prepares a display; with `quiet` nothing is printed."""
        self._quiet = quiet
        self._seconds = 2.0 if sys.stdout.isatty() else life.EVERY_S  # s between two lines
        self._last_line = -self._seconds

    def say(self, sentence: str, width: int = words.WIDTH) -> None:
        """Prints a sentence, on as many lines as it needs."""
        if not self._quiet:
            words.say(sentence, width)

    @contextlib.contextmanager
    def busy(self, work: str) -> Iterator[None]:
        """Prints that work begins, and now and then, while the block runs, that it goes on."""
        self.say(f"{work} ...")
        silent = self._quiet or sys.stderr is None  # closed
        with contextlib.nullcontext() if silent else life.shown(lambda: f"still {work}"):
            yield

    def show(
        self, texts: Mapping[str, str], update: int, updates: int, seconds_left: float, speeds: Row
    ) -> None:
        """Prints the state of the run in one line, not too often, and at its end."""
        if time.monotonic() < self._last_line + self._seconds and update < updates:
            return
        self._last_line = time.monotonic()
        parts = [f"update {update:,} of {updates:,}", *(" ".join(each) for each in texts.items())]
        speed = f"{speeds['arena_steps_per_s']:,.0f} steps/s"
        parts += [f"{words.duration(seconds_left)} left", speed]
        line = words.lines("  ".join(part.replace(" ", words.GLUE) for part in parts))
        self.say(line.partition("\n")[0])  # one line; the rest is left out
