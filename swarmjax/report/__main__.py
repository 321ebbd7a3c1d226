"""`python -m swarmjax.report run=DIR|runs=DIR,... [out=DIR]`: reports the results of runs.

For one run it writes its figures, and `report.html`, which holds all of them. The run may still be
going or may have been killed: the report leaves out a line that is not fully written. Needs no JAX.

For several runs it prints a table, and draws their success into the same panels.

Examples:
  # into runs/first/report
  python -m swarmjax.report run=runs/first
  # into a folder of your choice
  python -m swarmjax.report run=runs/first out=reports/first
  # a table and the curves of several runs, arrays and sweeps, into runs/report
  python -m swarmjax.report runs=runs/first,runs/array
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax import command, words
from swarmjax.config import files
from swarmjax.pages import builder
from swarmjax.report import page as report_page
from swarmjax.report import rows, table
from swarmjax.report.config import ReportConfig

PAGE = "report.html"


def write(run: Path, out: Path, made_by: str) -> list[Path]:
    """Writes the report of a run.

    Args:
      run: the run directory.
      out: directory of the report; it is created.
      made_by: the command that makes the report, for the page.

    Returns:
      The files; the page is the last one.

    Raises:
      ConfigError: if the run cannot be read, or `out` cannot be written.
    """
    history = rows.read(run)
    # Importing Matplotlib takes a second. Errors above should come without that delay.
    from swarmjax.report import figures as report_figures

    figures = report_figures.png_files(history)
    replay = report_page.replay(run, out)
    page = report_page.page(f"Report of {run}", made_by, history, figures, replay)
    content = {f"{name}.png": png for name, png in figures.items()} | {PAGE: page.encode()}
    return builder.write(out, content)


def compare(runs: Sequence[Path], out: Path) -> None:
    """Prints the table of runs, and draws their success on the stages that they share.

    Args:
      runs: run directories.
      out: directory of the picture; it is created.

    Raises:
      ConfigError: if a run cannot be read, or `out` cannot be written.
    """
    groups = table.read(runs)
    sys.stdout.write(f"{table.text([group.line for group in groups])}\n")
    stages = rows.shared_stages([each for group in groups for each in group.histories])
    if not stages:
        sys.stdout.write("No picture: these runs have no stage in common.\n")
        return
    from swarmjax.pages import figures as drawing
    from swarmjax.report import comparison

    png = drawing.png(comparison.success(groups, stages))
    (picture,) = builder.write(out, {"comparison.png": png})
    words.say(f"{picture}: success on {words.count(len(stages), 'stage')} over training.")


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(ReportConfig, arguments)
    if settings.runs is not None:
        runs = table.find(settings.runs)
        compare(runs, Path(settings.out or runs[0].parent / "report"))
        return 0
    run = Path(settings.run or "")
    out = Path(settings.out or run / "report")
    made_by = command.line("report", *arguments)
    written = write(run, out, made_by)
    figures = words.count(len(written) - 1, "figure")
    words.say(f"{written[-1]}: the report of {run}, with {figures}.")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("report", main, ReportConfig))
