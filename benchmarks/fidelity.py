"""How realistic is the simulated robot? Compares it with the real robot and with Webots' robot.

`python -m benchmarks.fidelity [out=FILE]` measures both bodies in MuJoCo's C engine and prints one
table. `out` writes JSON lines: first a line with versions and commit, then a line for each row.

Our numbers are read from the compiled model or from the simulated robot's motion. The files of this
benchmark hold the reference numbers a second time, each with its source. If the robot and the
reference took a number from the same line of code, the comparison would prove nothing. Where a
source differs from Webots' own numbers, the error shows the spread between sources.
"""

import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks import fidelity_infrared, fidelity_motion, lines
from benchmarks import fidelity_rig as rig
from benchmarks.fidelity_rig import Rig, Row
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.task.stage_files import load_levels

ROBOTS = ("planar", "wheeled", "planar_v2", "wheeled_v2")  # files of configs/robot/
PLAIN_WIDTH = 180  # columns
HEADS = ("quantity", "unit", "theirs", "source", "planar", "wheeled", "error")


@dataclass(frozen=True, kw_only=True)
class FidelityConfig(Section):
    """Settings: where to write the table, in addition to the terminal."""

    out: str | None = field(default=None, metadata=about("file of JSON lines"))


def rigs() -> list[Rig]:
    """Makes a rig for each robot in `ROBOTS`, in this order."""
    keys = (["policy=none", f"robot={name}"] for name in ROBOTS)
    return [rig.load(load_levels(EvaluateConfig, words).robot) for words in keys]


def measure(benches: Sequence[Rig]) -> list[Row]:
    """Measures all rows.

    Args:
      benches: the rigs, from `rigs`.

    Returns:
      The rows, grouped by section.
    """
    planar, wheeled, planar_v2, wheeled_v2 = benches
    return [
        *rig.rows(planar, wheeled, planar_v2, wheeled_v2),
        *fidelity_motion.rows(planar, wheeled, planar_v2, wheeled_v2),
        *fidelity_infrared.rows(planar, wheeled),
    ]


# Output


def head() -> dict[str, Any]:
    """Returns the first JSON line, with the versions and the commit that measured the rows."""
    return {
        "benchmark": "fidelity",
        "engine": "c",
        "control_step": rig.CONTROL_STEP,
        "substeps": rig.SUBSTEPS,
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def _sections(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    for name, members in itertools.groupby(rows, key=lambda row: row.section):
        yield name, list(members)


def _cells(row: Row) -> list[str]:
    """Writes the cells of a row, in the order of `HEADS`."""
    numbers = [_number(value) for value in (row.theirs, row.planar, row.wheeled)]
    error = "" if row.error is None else f"{100 * row.error:.2f} %"
    return [row.quantity, row.unit, numbers[0], row.source, *numbers[1:], error]


def _number(value: float | None) -> str:
    """Writes a number with five significant digits; 0 below 1e-12, which is rounding error."""
    if value is None:
        return ""
    return "0" if abs(value) < 1e-12 else f"{value:.5g}"


def print_table(rows: Sequence[Row], console: Console) -> None:
    """Prints the rows, with one part of the table per section."""
    if not console.is_terminal:  # the lines of a file can be wide
        console.width = PLAIN_WIDTH
    table = Table(box=box.SIMPLE if console.is_terminal else None)
    for name in HEADS:
        table.add_column(name, justify="right" if name in ("theirs", *HEADS[4:]) else "left")
    for section, members in _sections(rows):
        table.add_row(f"[bold]{section}[/bold]")
        for row in members:
            table.add_row(*_cells(row))
        table.add_section()
    console.print(table)


def write_lines(path: Path, rows: Sequence[Row]) -> None:
    """Writes the JSON lines; raises ConfigError if the file cannot be written."""
    content = [head(), *(row.line() for row in rows)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(json.dumps(line, allow_nan=False) + "\n" for line in content))
    except OSError as error:
        raise ConfigError(f"out is {path}, which cannot be written: {error.strerror}.") from None


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = lines.load(FidelityConfig, arguments)
    rows = measure(rigs())
    if settings.out is not None:
        write_lines(Path(settings.out), rows)
    print_table(rows, Console())
    return 0


if __name__ == "__main__":
    sys.exit(command.run("fidelity", main, FidelityConfig))
