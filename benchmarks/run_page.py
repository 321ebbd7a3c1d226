"""Writes the tables and plots of a file of results into docs/benchmarks.md."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import pages, run_figures, run_tables
from swarmjax.config import ConfigError

PAGE = "benchmarks.md"
MARKER = "results"


def write(folder: Path, lines: Sequence[dict[str, Any]], source: Path) -> None:
    """Writes the generated part of the page, and the plots into a folder next to the page.

    Args:
      folder: folder of the page.
      lines: lines of the results.
      source: file of the results, whose name appears on the page.

    Raises:
      ConfigError: if the page is missing, or has no place for the tables.
    """
    path = folder / PAGE
    try:
        text = path.read_text()
        plots = run_figures.draw(folder / "figures", lines)
        shown = [f"![{each.stem}](figures/{each.name})" for each in plots]
        written = f"Written by `benchmarks.run` from `{source}`."
        part = "\n\n".join([written, *shown, run_tables.markdown(lines)])
        path.write_text(pages.insert(text, PAGE, MARKER, part))
    except OSError as error:
        raise ConfigError(f"docs is {folder}, which cannot be used: {error.strerror}.") from None
