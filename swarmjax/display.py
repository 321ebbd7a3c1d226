"""What a run shows while it trains: a live table on a terminal, plain lines elsewhere."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

Row = Mapping[str, Any]

LINE_SECONDS = 2.0  # least time between two plain lines
_SPEEDS = (
    ("arena steps/s", "arena_steps_per_s"),
    ("robot steps/s", "robot_steps_per_s"),
    ("physics steps/s", "physics_steps_per_s"),
    ("transitions/s", "transitions_per_s"),
)


def summarize(rows: Sequence[Row]) -> dict[str, Any]:
    """Sums the rows of a call up: means over all episodes that ended on the newest stage.

    Args:
      rows: as `recorder.rows` makes them.

    Returns:
      `stage`, `update`, `targets_reached`, `all_reached`, `contacts_per_robot`, `return`,
      `episodes` and `stage_success`; shares are None where no episode ended.
    """
    newest = rows[-1]["stage"]
    mine = [row for row in rows if row["stage"] == newest]

    def share(part: str, whole: str) -> float | None:
        total = sum(row[whole] for row in mine)
        return sum(row[part] for row in mine) / total if total else None

    return {
        "stage": newest,
        "update": rows[-1]["update"] + 1,
        "episodes": sum(row["episodes"] for row in mine),
        "targets_reached": share("reached", "targets"),
        "all_reached": share("complete", "episodes"),
        "return": share("reward", "targets"),
        "contacts_per_robot": share("contacts", "targets"),
        "stage_success": rows[-1]["stage_success"],
        "value_loss": rows[-1]["value_loss"],
        "policy_loss": rows[-1]["policy_loss"],
        "std": rows[-1]["std"],
    }


class Display:
    """Shows the run on a console. Use it with `with`."""

    def __init__(self, updates: int, console: Console | None = None) -> None:
        """Prepares a display for a run of `updates` updates."""
        self._updates = updates
        self._console = console or Console()
        self._live = Live(console=self._console, auto_refresh=False)
        self._last_line = -LINE_SECONDS

    def say(self, sentence: str) -> None:
        """Prints a sentence that stays."""
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    def show(self, summary: Row, speeds: Row, seconds_left: float) -> None:
        """Shows where the run stands."""
        if self._console.is_terminal:
            self._live.update(_table(summary, speeds, self._updates, seconds_left), refresh=True)
            return
        now = time.monotonic()
        if now - self._last_line >= LINE_SECONDS or summary["update"] == self._updates:
            self._last_line = now
            self.say(_line(summary, speeds, self._updates, seconds_left))

    def __enter__(self) -> "Display":
        """Starts the live table on a terminal."""
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leaves the last table standing."""
        if self._console.is_terminal:
            self._live.stop()


def _table(summary: Row, speeds: Row, updates: int, seconds_left: float) -> Table:
    """Lays the live table out: how the swarm does beside how fast the run goes."""
    table = Table(title=f"swarmjax: stage {summary['stage']}", title_justify="left")
    for heading in ("swarm", "run"):
        table.add_column(heading)
        table.add_column(justify="right")
    left = [
        ("targets reached", _percent(summary["targets_reached"])),
        ("all robots reached", _percent(summary["all_reached"])),
        ("stage success", _percent(summary["stage_success"])),
        ("contacts per robot", _number(summary["contacts_per_robot"])),
        ("return", _number(summary["return"])),
        ("policy loss", _number(summary["policy_loss"])),
        ("value loss", _number(summary["value_loss"])),
    ]
    right = [
        ("update", f"{summary['update']:,} of {updates:,}"),
        *((name, f"{speeds[key]:,.0f}") for name, key in _SPEEDS),
        ("compile time", f"{speeds['compile_s']:.1f} s"),
        ("time left", _clock(seconds_left)),
    ]
    for a, b in zip(left, right, strict=True):
        table.add_row(*a, *b)
    return table


def _line(summary: Row, speeds: Row, updates: int, seconds_left: float) -> str:
    """Says in one line what the table shows."""
    return (
        f"update {summary['update']}/{updates}  stage {summary['stage']}  "
        f"targets {_percent(summary['targets_reached'])}  "
        f"success {_percent(summary['stage_success'])}  "
        f"contacts {_number(summary['contacts_per_robot'])}  "
        f"return {_number(summary['return'])}  "
        f"arena steps/s {speeds['arena_steps_per_s']:,.0f}  "
        f"robot steps/s {speeds['robot_steps_per_s']:,.0f}  "
        f"physics steps/s {speeds['physics_steps_per_s']:,.0f}  "
        f"transitions/s {speeds['transitions_per_s']:,.0f}  left {_clock(seconds_left)}"
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
