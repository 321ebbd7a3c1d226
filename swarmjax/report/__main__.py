"""`python -m swarmjax.report run=DIR|runs=DIR,... [out=DIR]`: reports the results of runs.

For one run it writes `mix.png`, `success.png`, `curves.png`, and `report.html`, which holds all
figures. If the stages make a grid, it also writes `grid.png`. The run may still be going or may
have been killed: the report leaves out a line that is not fully written. No JAX.

For several runs it prints a table: see `table`. With `out` it also writes the table there, as
`report.html` and `report.json`.
"""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax import command, words
from swarmjax.config import files
from swarmjax.pages import builder
from swarmjax.report import page as report_page
from swarmjax.report import rows, table
from swarmjax.report import send as report_send
from swarmjax.report.config import ReportConfig

PAGE, TABLE = "report.html", "report.json"


def write(
    run: Path, out: Path, made_by: str, *, send: bool = False, overwrite: bool = False
) -> list[Path]:
    """Writes the report of a run.

    Args:
      run: the run directory.
      out: directory of the report; it is created.
      made_by: the command that makes the report, for the page.
      send: whether the run's loggers also get the figures and the pages in the run directory.
      overwrite: whether files of other origin are replaced.

    Returns:
      The files.

    Raises:
      ConfigError: if the run cannot be read, `out` cannot be written, or `send` finds no logger.
    """
    history = rows.read(run)
    loggers = report_send.of_run(run, history) if send else []
    # Importing Matplotlib takes a second. Errors above should come without that delay.
    from swarmjax.report import figures as report_figures

    figures = report_figures.draw(history)
    page = report_page.page(f"Report of {run}", made_by, history, figures)
    content = {f"{name}.png": png for name, png in figures.items()} | {PAGE: page.encode()}
    written = builder.write(out, content, overwrite=overwrite)
    report_send.send(history, [*written, *sorted(run.glob("*.html"))], loggers)
    return written


def write_table(
    lines: Sequence[table.TableLine], out: Path, made_by: str, *, overwrite: bool = False
) -> list[Path]:
    """Writes the table of several runs.

    Args:
      lines: the lines of the table.
      out: directory of the report; it is created.
      made_by: the command that makes the table, for the page.
      overwrite: whether files of other origin are replaced.

    Returns:
      The files.

    Raises:
      ConfigError: if `out` cannot be written.
    """
    page = report_page.table_page("Runs", made_by, lines)
    found = json.dumps(table.plain(lines), indent=2) + "\n"
    content = {TABLE: found.encode(), PAGE: page.encode()}
    return builder.write(out, content, overwrite=overwrite)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(ReportConfig, arguments)
    made_by = shlex.join(["python", "-m", "swarmjax.report", *arguments])
    if settings.runs is not None:
        lines = table.read(table.find(settings.runs))
        sys.stdout.write(f"{table.text(lines)}\n")
        if settings.out:
            written = write_table(lines, Path(settings.out), made_by, overwrite=settings.overwrite)
            sys.stdout.write(f"{written[-1]}: the same table as a page.\n")
        return 0
    run = Path(settings.run or "")
    out = Path(settings.out) if settings.out else run / "report"
    written = write(run, out, made_by, send=settings.send, overwrite=settings.overwrite)
    figures = words.count(len(written) - 1, "figure")
    sys.stdout.write(f"{written[-1]}: the report of {run}, with {figures}.\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("report", main, ReportConfig))
