"""`python -m swarmjax.report run=DIR|runs=DIR,... [out=DIR]`: reports the results of runs.

For one run it writes its figures, and `report.html`, which holds all of them. The run may still be
going or may have been killed: the report leaves out a line that is not fully written. No JAX.

For several runs it prints a table: see `table`. With `out` it also writes the table there, as
`report.html` and `report.json`.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax import command, words
from swarmjax.config import files
from swarmjax.pages import builder
from swarmjax.report import page as report_page
from swarmjax.report import rows, table
from swarmjax.report.config import ReportConfig
from swarmjax.report.table import TableLine

PAGE, TABLE = "report.html", "report.json"


def write(run: Path, out: Path, made_by: str, *, overwrite: bool = False) -> list[Path]:
    """Writes the report of a run.

    Args:
      run: the run directory.
      out: directory of the report; it is created.
      made_by: the command that makes the report, for the page.
      overwrite: whether files of other origin are replaced.

    Returns:
      The files.

    Raises:
      ConfigError: if the run cannot be read, or `out` cannot be written.
    """
    history = rows.read(run)
    # Importing Matplotlib takes a second. Errors above should come without that delay.
    from swarmjax.report import figures as report_figures

    figures = report_figures.png_files(history)
    page = report_page.page(f"Report of {run}", made_by, history, figures)
    content = {f"{name}.png": png for name, png in figures.items()} | {PAGE: page.encode()}
    return builder.write(out, content, overwrite=overwrite)


def _write_table(lines: Sequence[TableLine], made_by: str, settings: ReportConfig) -> Path:
    """Writes the table of several runs; returns the path of its page."""
    page = builder.render(
        "report/runs.html",
        styles=report_page.STYLES,
        title="Runs",
        command=made_by,
        heads=table.HEADS,
        rows=table.cells(lines),
        note=table.note(lines),
    )
    text = json.dumps(table.plain(lines), indent=2) + "\n"
    content = {TABLE: text.encode(), PAGE: page.encode()}
    return builder.write(Path(settings.out or ""), content, overwrite=settings.overwrite)[-1]


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(ReportConfig, arguments)
    made_by = command.line("report", *arguments)
    if settings.runs is not None:
        lines = table.read(table.find(settings.runs))
        sys.stdout.write(f"{table.text(lines)}\n")
        if settings.out:
            page = _write_table(lines, made_by, settings)
            sys.stdout.write(f"{page}: the same table as a page.\n")
        return 0
    run = Path(settings.run or "")
    out = Path(settings.out) if settings.out else run / "report"
    written = write(run, out, made_by, overwrite=settings.overwrite)
    figures = words.count(len(written) - 1, "figure")
    sys.stdout.write(f"{written[-1]}: the report of {run}, with {figures}.\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("report", main, ReportConfig))
