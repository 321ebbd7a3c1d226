"""Shows a run while it trains, as plain lines."""

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from swarmjax import words

Row = Mapping[str, Any]

LINE_SECONDS = 2.0  # shortest time between two lines


def figures(rows: Sequence[Row], names: Sequence[str], speeds: Row) -> dict[str, str]:
    """Formats what a call shows.

    The episodes that end in an update are a biased sample, because short ones end first. The newest
    whole cohort measures how good the swarm is: all episodes that began within one step limit.

    Args:
      rows: rows of all seeds, as `recorder.rows` makes them, in order.
      names: names of the stages, in order.
      speeds: speeds of the call over all seeds.

    Returns:
      Texts by name. Each is for the newest stage of each seed.
    """
    last = [row for row in rows if row["update"] == rows[-1]["update"]]
    newest = [names.index(row["stage"]) for row in last]
    first, final = names[min(newest)], names[max(newest)]

    def cohort(column: str) -> str:
        return spread([row[column][stage] for row, stage in zip(last, newest, strict=True)])

    stage_of = dict(zip((row["seed"] for row in last), newest, strict=True))
    mine = [row for row in rows if names.index(row["stage"]) == stage_of[row["seed"]]]
    return {
        "stage": first if first == final else f"{first} to {final}",
        "targets reached": cohort("success_by_stage"),
        "all robots reached": cohort("complete_by_stage"),
        "targets in episodes just ended": _ratio(mine, "reached", 100, " %"),
        "contacts per robot": _ratio(mine, "contacts"),
        "return": _ratio(mine, "reward"),
        **{
            name.removesuffix("_per_s").replace("_", " ") + "/s": f"{speed:,.0f}"
            for name, speed in speeds.items()
            if name.endswith("_per_s")
        },
    }


def spread(shares: Sequence[float | None]) -> str:
    """Formats a share, with its smallest and largest value over the seeds that measured it."""
    measured = [100 * share for share in shares if share is not None]
    if not measured:
        return "not measured yet"
    mean, low, high = sum(measured) / len(measured), min(measured), max(measured)
    return f"{mean:.1f} %" + (f" ({low:.0f} to {high:.0f})" if low < high else "")


def _ratio(rows: Sequence[Row], part: str, scale: float = 1.0, unit: str = "") -> str:
    """Formats a mean over the targets of episodes that ended in a call, or `-` if none ended."""
    targets = sum(row["targets"] for row in rows)
    return f"{scale * sum(row[part] for row in rows) / targets:.3g}{unit}" if targets else "-"


class Display:
    """Prints what a run says, line by line."""

    def __init__(self, *, quiet: bool = False) -> None:
        """Prepares a display; with `quiet` nothing is printed."""
        self._quiet = quiet
        self._last_line = -LINE_SECONDS

    def say(self, sentence: str) -> None:
        """Prints a sentence."""
        if not self._quiet:
            sys.stdout.write(f"{sentence}\n")
            sys.stdout.flush()

    def show(
        self, texts: Mapping[str, str], update: int, updates: int, seconds_left: float
    ) -> None:
        """Prints the state of the run, at most every `LINE_SECONDS`, and at its end."""
        if time.monotonic() < self._last_line + LINE_SECONDS and update < updates:
            return
        self._last_line = time.monotonic()
        shown = {
            "update": f"{update:,} of {updates:,}",
            **texts,
            "time left": words.duration(seconds_left),
        }
        self.say("  ".join(f"{name} {text}" for name, text in shown.items()))
