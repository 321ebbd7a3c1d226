"""Shows a run while it trains: a live table on a terminal, plain lines elsewhere."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from swarmjax import words

Row = Mapping[str, Any]

LINE_SECONDS = 2.0  # shortest time between two plain lines
MOST_STAGES = 8  # with more stages, the table shows only three of them
GOOD = 0.9  # a stage counts as good if it reaches a larger share of its targets
_SPEEDS = (
    ("arena steps/s", "arena_steps_per_s"),
    ("robot steps/s", "robot_steps_per_s"),
    ("physics steps/s", "physics_steps_per_s"),
    ("transitions/s", "transitions_per_s"),
)


class Spread(NamedTuple):
    """Mean, minimum and maximum of a figure over the seeds."""

    mean: float
    low: float
    high: float


class StageState(NamedTuple):
    """State of a stage.

    Attributes:
      name: name of the stage.
      arenas: share of the arenas that are on this stage, mean over seeds.
      success: share of targets reached in the stage's newest measurement, over the seeds that have
        measured it; None if no seed has.
    """

    name: str
    arenas: float
    success: Spread | None


def summarize(rows: Sequence[Row], names: Sequence[str]) -> dict[str, Any]:
    """Summarises the rows of a call, on the newest stage of each seed.

    The episodes that end in an update are a biased sample, because short ones end first. The newest
    whole cohort measures how good the swarm is: all episodes that began within one step limit.

    Args:
      rows: rows of all seeds, as `recorder.rows` makes them. Rows of one seed are in order.
      names: names of the stages, in order.

    Returns:
      A dictionary. Figures over seeds are a `Spread`.

      - `stage`: the newest stage, or the range of newest stages over seeds.
      - `update` and `episodes`: counts.
      - `cohort_targets`: share of targets reached in the newest cohort; None before there is one.
      - `cohort_complete`: share of the cohort's episodes in which all robots arrived; None as
        above.
      - `ended_targets`, `contacts_per_robot`, `return`: over the episodes that ended; None if none
        ended.
      - `value_loss`, `policy_loss`: the newest losses.
      - `stages`: the `StageState` of each stage.
    """
    by_seed: dict[int, list[Row]] = {}
    for row in rows:
        by_seed.setdefault(row["seed"], []).append(row)
    each = [_of_seed(mine, names) for mine in by_seed.values()]
    last = [mine[-1] for mine in by_seed.values()]
    newest = sorted({names.index(row["stage"]) for row in last})
    first, final = names[newest[0]], names[newest[-1]]
    over_seeds = {key: spread([one[key] for one in each]) for key in each[0].keys() - {"episodes"}}
    return over_seeds | {
        "stage": first if first == final else f"{first} to {final}",
        "update": rows[-1]["update"] + 1,
        "episodes": sum(one["episodes"] for one in each),
        "stages": tuple(_stage(last, i, name) for i, name in enumerate(names)),
    }


def _of_seed(rows: Sequence[Row], names: Sequence[str]) -> dict[str, Any]:
    """Summarises the rows of one seed."""
    newest = rows[-1]
    stage = names.index(newest["stage"])
    mine = [row for row in rows if row["stage"] == newest["stage"]]

    def share(part: str, whole: str) -> float | None:
        total = sum(row[whole] for row in mine)
        return sum(row[part] for row in mine) / total if total else None

    return {
        "episodes": sum(row["episodes"] for row in mine),
        "cohort_targets": newest["success_by_stage"][stage],
        "cohort_complete": newest["complete_by_stage"][stage],
        "ended_targets": share("reached", "targets"),
        "return": share("reward", "targets"),
        "contacts_per_robot": share("contacts", "targets"),
        **{key: newest[key] for key in ("value_loss", "policy_loss")},
    }


def spread(values: Sequence[float | None]) -> Spread | None:
    """Returns the spread of the values that are not None; None if all values are None."""
    there = [value for value in values if value is not None]
    return Spread(sum(there) / len(there), min(there), max(there)) if there else None


def _stage(last: Sequence[Row], index: int, name: str) -> StageState:
    """Returns the state of a stage, by the last row of each seed."""
    arenas = sum(row["mix"][index] / sum(row["mix"]) for row in last) / len(last)
    success = spread([row["success_by_stage"][index] for row in last])
    return StageState(name, arenas, success)


@contextlib.contextmanager
def working(what: str, console: Console | None = None) -> Iterator[None]:
    """Shows on a terminal what is in progress and for how long. Elsewhere, shows nothing.

    Args:
      what: what is in progress, for example `compiling`.
      console: where to show it; None for standard error, which scripts do not read.
    """
    console = console or Console(stderr=True)
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        bar.add_task(what, total=None)
        yield


class Display:
    """Shows the run on a console, in a `with` block.

    A closed terminal or a pipe without a reader does not stop the run.
    """

    def __init__(self, updates: int, console: Console | None = None) -> None:
        """Prepares a display for a run of `updates` updates."""
        self._updates = updates
        self._console = console or Console()
        self._live = Live(console=self._console, auto_refresh=False)
        self._last_line = -LINE_SECONDS

    def say(self, sentence: str) -> None:
        """Prints a sentence above the live table."""
        with contextlib.suppress(OSError):
            self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    @contextlib.contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Shows what is in progress: with a timer on a terminal, as one line elsewhere."""
        if not self._console.is_terminal:
            self.say(f"{what} ...")
        with working(what, self._console):
            yield

    def hear(self, rows: Sequence[Row], speeds: Row) -> None:
        """Receives the rows and speeds of a call. Subclasses that listen to a run override it."""

    def show(self, summary: Row, speeds: Row, seconds_left: float) -> None:
        """Shows the state of the run."""
        if self._console.is_terminal:
            with contextlib.suppress(OSError):
                self._live.start()  # not earlier: until then, `working` uses the terminal
                table = _table(summary, speeds, self._updates, seconds_left)
                self._live.update(table, refresh=True)
            return
        now = time.monotonic()
        if now - self._last_line >= LINE_SECONDS or summary["update"] == self._updates:
            self._last_line = now
            self.say(_line(summary, speeds, self._updates, seconds_left))

    def __enter__(self) -> "Display":
        """Returns itself. The live table starts with the first call of `show`."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stops the live display and leaves the last table on screen."""
        with contextlib.suppress(OSError):
            self._live.stop()


def _table(summary: Row, speeds: Row, updates: int, seconds_left: float) -> Group:
    """Lays out the live table: results on the left, speeds on the right, stages below."""
    table = Table(title=f"swarmjax: stage {summary['stage']}", title_justify="left")
    for heading in ("swarm", "run"):
        table.add_column(heading)
        table.add_column(justify="right")
    left = [
        ("targets reached", measured(summary["cohort_targets"])),
        ("- in episodes just ended", _percent(summary["ended_targets"])),
        ("all robots reached", measured(summary["cohort_complete"])),
        ("contacts per robot", _number(summary["contacts_per_robot"])),
        ("return", _number(summary["return"])),
        ("policy loss", _number(summary["policy_loss"])),
        ("value loss", _number(summary["value_loss"])),
    ]
    right = [
        ("update", f"{summary['update']:,} of {updates:,}"),
        *((name, f"{speeds[key]:,.0f}") for name, key in _SPEEDS),
        ("compile time", words.duration(speeds["compile_s"])),
        ("time left", words.duration(seconds_left)),
    ]
    for a, b in zip(left, right, strict=True):
        table.add_row(*a, *b)
    stages = summary["stages"]
    several = len(stages) > 1
    return Group(table, _stage_table(stages)) if several else Group(table)


def _stage_table(stages: Sequence[StageState]) -> Table:
    """Lists the stages.

    If there are many stages, only three are listed: the one with most arenas, the best and the
    worst.
    """
    table = Table(
        caption=_counted(stages), caption_justify="left", box=box.SIMPLE_HEAD, show_edge=False
    )
    for heading in ("stage", "arenas", "targets reached"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    shown = [("", stage) for stage in stages]
    if len(stages) > MOST_STAGES:
        shown = [("most arenas: ", max(stages, key=lambda stage: stage.arenas))]
        measured = _measured(stages)
        if measured:
            shown += [("best: ", measured[-1]), ("worst: ", measured[0])]
    for what, stage in shown:
        arenas, name = f"{100 * stage.arenas:.0f} %", f"{what}{stage.name}"
        table.add_row(name, arenas, _percent(stage.success))
    return table


def _measured(stages: Sequence[StageState]) -> list[StageState]:
    """Returns the stages that have been measured, worst first."""
    found = [(stage.success.mean, i) for i, stage in enumerate(stages) if stage.success is not None]
    return [stages[i] for _, i in sorted(found)]


def _counted(stages: Sequence[StageState]) -> str:
    """Counts the stages on which the swarm reaches nearly all targets."""
    good = sum(stage.success is not None and stage.success.mean > GOOD for stage in stages)
    return f"{good} of {words.count(len(stages), 'stage')} above {100 * GOOD:.0f} %"


def _line(summary: Row, speeds: Row, updates: int, seconds_left: float) -> str:
    """Formats the contents of the table in one line."""
    return (
        f"update {summary['update']}/{updates}  stage {summary['stage']}  "
        f"targets reached {measured(summary['cohort_targets'])} "
        f"({_percent(summary['ended_targets'])} in episodes just ended)  "
        f"{_stages_in_line(summary['stages'])}"
        f"contacts {_number(summary['contacts_per_robot'])}  "
        f"return {_number(summary['return'])}  "
        f"arena steps/s {speeds['arena_steps_per_s']:,.0f}  "
        f"robot steps/s {speeds['robot_steps_per_s']:,.0f}  "
        f"physics steps/s {speeds['physics_steps_per_s']:,.0f}  "
        f"transitions/s {speeds['transitions_per_s']:,.0f}  left {words.duration(seconds_left)}"
    )


def _stages_in_line(stages: Sequence[StageState]) -> str:
    """Formats the state of a curriculum's stages; empty for a single stage."""
    if len(stages) == 1:
        return ""
    worst = "".join(
        f", worst {stage.name} {_percent(stage.success)}" for stage in _measured(stages)[:1]
    )
    return f"{_counted(stages)}{worst}  "


def measured(share: Spread | None) -> str:
    """Formats a share over a whole cohort, or says that it is not measured yet."""
    return "not measured yet" if share is None else _percent(share)


def _percent(share: Spread | None) -> str:
    return _with_range(share, lambda value, digits: f"{100 * value:.{digits}f}", " %")


def _number(value: Spread | None) -> str:
    return _with_range(value, lambda number, digits: f"{number:.{2 + digits}g}", "")


def _with_range(found: Spread | None, write: Callable[[float, int], str], unit: str) -> str:
    """Formats a mean and the range over seeds, the range with one digit less."""
    if found is None:
        return "-"
    text = f"{write(found.mean, 1)}{unit}"
    if found.low == found.high:
        return text
    return f"{text} ({write(found.low, 0)} to {write(found.high, 0)})"
