"""`python -m swarmjax.report run=DIR [out=DIR]`: what a run came to, as figures and one page.

Writes `mix.png`, `success.png`, `curves.png`, `grid.png` if the stages make a grid, and
`report.html`, which holds them all. The run may be under way or have been killed: what it has not
finished writing is left out. No JAX.
"""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax import command, words
from swarmjax.config import ConfigError, files
from swarmjax.report import page as report_page
from swarmjax.report import rows
from swarmjax.report.config import ReportConfig

PAGE = "report.html"


def write(run: Path, out: Path, made_by: str) -> list[Path]:
    """Writes the report of a run.

    Args:
      run: the run directory.
      out: directory of the report, which is made.
      made_by: the command that makes it, for the page.

    Returns:
      The files.

    Raises:
      ConfigError: if the run cannot be read, or `out` not be written.
    """
    history = rows.read(run)
    from swarmjax.report import (
        figures as report_figures,
    )  # Matplotlib takes a second, which no refusal should

    figures = report_figures.draw(history)
    page = report_page.page(f"Report of {run}", made_by, history, figures)
    files = {f"{name}.png": png for name, png in figures.items()} | {PAGE: page.encode()}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (out / name).write_bytes(content)
    except OSError as error:
        raise ConfigError(f"out is {out}, which cannot be written: {error.strerror}.") from None
    return [out / name for name in files]


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(ReportConfig, arguments)
    run = Path(settings.run)
    out = Path(settings.out) if settings.out else run / "report"
    made_by = shlex.join(["python", "-m", "swarmjax.report", *arguments])
    written = write(run, out, made_by)
    figures = words.count(len(written) - 1, "figure")
    sys.stdout.write(f"{written[-1]}: the report of {run}, with {figures}.\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("report", main, ReportConfig))
