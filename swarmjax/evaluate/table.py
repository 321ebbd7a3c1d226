"""Tables of an evaluation, for a terminal and, level by level, as CSV."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from swarmjax import words
from swarmjax.evaluate.measures import MEASURES, Measure
from swarmjax.evaluate.trials import Entrant, Trial

# Columns of a table with several cells: heading, measure, statistic, and whether to show the
# interval.
_COLUMNS = (
    ("targets, %", "targets_reached", "mean", True),
    ("worst 5 %", "targets_reached", "cvar", False),
    ("all, %", "all_reached", "mean", True),
    ("SPL, %", "spl", "mean", False),
    ("time, s", "time_to_reach_s", "mean", False),
    ("contacts", "contacts_per_robot", "mean", False),
    ("with robots", "contacts_robot", "mean", False),
    ("stuck, %", "deadlocks", "mean", False),
)


def console() -> Console:
    """Returns a console for standard output, at most `words.WIDTH` letters wide."""
    found = Console()
    found.width = min(found.width, words.WIDTH) if found.is_terminal else words.WIDTH
    return found


def show(console: Console, result: Mapping[str, Any]) -> None:
    """Prints a result; without styles unless the output is a terminal.

    Args:
      console: Console to print on.
      result: From `summary.result`, for policies or for a comparison.
    """
    cells = result["cells"]
    sides = result.get("compared", [result.get("policies")])
    who = " against ".join(_names(side) for side in sides)
    where = cells[0]["cell"] if result["suite"] is None else f"suite {result['suite']}"
    episodes = sum(cell["episodes"] for cell in cells)
    acting = ", each robot's most likely action" if result["action"] == "mean" else ""
    words.say(f"{who} on {where}, {episodes:,} episodes{acting}")
    own = {name: Measure(**each) for name, each in result.get("own_measures", {}).items()}
    about = {**MEASURES, **own}
    if "compared" in result:
        for cell in cells:
            _show_comparison(console, cell, about)
        if result["pooled"] is not None:
            _show_comparison(console, {"cell": "all", **result["pooled"]}, about)
    elif len(cells) == 1:
        _show_cell(console, cells[0], about)
    else:
        _show_cells(console, result)
    for cell in cells:
        if cell["unreachable"]:
            words.say(
                f"{cell['unreachable']} of {cell['episodes']:,} levels of {cell['cell']} have a "
                "target that no robot can reach."
            )


def _names(side: Sequence[Mapping[str, str]]) -> str:
    more = len(side) - 1
    return f"{words.shorten(side[0]['path'], 80)}{f' and {more} more' if more else ''}"


def make_table(console: Console, *heads: str) -> Table:
    """Makes a table without rows. Long names in the first column wrap; numbers do not."""
    form, left = box.SIMPLE if console.is_terminal else None, int(len(heads) < 9)
    table = Table(box=form, padding=(0, 1, 0, left))
    for i, head in enumerate(heads):
        table.add_column(head, justify="right" if i else "left", no_wrap=bool(i), overflow="fold")
    return table


def _show_cell(console: Console, cell: Mapping[str, Any], about: Mapping[str, Measure]) -> None:
    """Prints one cell: a row for each measure."""
    table = make_table(console, "", "mean", "95 %", "IQM", "95 %", "worst 5 %")
    for name, figures in cell["measures"].items():
        measure = about[name]
        mean, iqm, worst = (_number(figures[key], measure) for key in ("mean", "iqm", "cvar"))
        ends = [_interval(figures[f"{key}_interval"], measure) for key in ("mean", "iqm")]
        table.add_row(_label(measure), mean, ends[0], iqm, ends[1], worst)
    console.print(table)


def _show_cells(console: Console, result: Mapping[str, Any]) -> None:
    """Prints several cells: a row for each, and one for all if they can be pooled."""
    table = make_table(console, "", "levels", *(column[0] for column in _COLUMNS))
    pooled = [] if result["pooled"] is None else [{"cell": "all", **result["pooled"]}]
    for cell in (*result["cells"], *pooled):
        values = (_shown(cell["measures"], *column[1:]) for column in _COLUMNS)
        table.add_row(cell["cell"], f"{cell['episodes']:,}", *values)
    console.print(table)


def _shown(figures: Mapping[str, Any], name: str, key: str, with_ends: bool) -> str:
    if name not in figures:  # path efficiency, where targets move
        return "-"
    shown = _number(figures[name][key], MEASURES[name])
    interval = figures[name][f"{key}_interval"] if with_ends else None
    return shown if interval is None else f"{shown} {_interval(interval, MEASURES[name])}"


def _show_comparison(
    console: Console, cell: Mapping[str, Any], about: Mapping[str, Measure]
) -> None:
    """Prints one cell of a comparison: a row for each measure."""
    heads = ("a", "b", "b - a", "95 %", "b better, %", "95 %")
    table = make_table(console, f"{cell['cell']}, {cell['episodes']:,} levels", *heads)
    for name, figures in cell["measures"].items():
        measure, share = about[name], MEASURES["targets_reached"]
        row = [_number(figures["a"], measure), _number(figures["b"], measure)]
        if "difference" in figures:
            for key, of, sign in (("difference", measure, "+"), ("improvement", share, "")):
                row.append(_number(figures[key], of, sign))
                row.append(_interval(figures[f"{key}_interval"], of, sign))
        table.add_row(_label(measure), *row)
    console.print(table)


def _label(measure: Measure) -> str:
    return f"{measure.label}, {measure.unit}" if measure.unit else measure.label


def _interval(ends: Sequence[float] | None, measure: Measure, sign: str = "") -> str:
    if ends is None:
        return "-"
    return "[" + ", ".join(_number(end, measure, sign) for end in ends) + "]"


def _number(value: float, measure: Measure, sign: str = "") -> str:
    if measure.unit == "%":
        return f"{100 * value:{sign}.1f}"
    return f"{value:{sign}.1f}" if measure.unit == "s" else f"{value:{sign}.3f}"


def levels(entrants: Sequence[Entrant], trials: Sequence[Trial]) -> str:
    """Makes a CSV file with a row for each policy and level.

    Args:
      entrants: The policies, in the order of the trials' rows.
      trials: Their results, one for each cell.
    """
    names, text = [*trials[0].measures], io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["cell", "episode", "policy", "unreachable", *names])
    for trial in trials:
        lost = np.isinf(trial.shortest).sum(axis=-1).tolist()
        for i, entrant in enumerate(entrants):
            table = zip(*(trial.measures[name][i].tolist() for name in names), strict=True)
            for number, missing, values in zip(trial.cell.episodes, lost, table, strict=True):
                rows.writerow([trial.cell.name, int(number), entrant.path, missing, *values])
    return text.getvalue()
