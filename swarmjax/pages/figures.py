"""Provides common code for the figures of pages: files, scales and legends."""

import io
from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, PercentFormatter
from PIL import Image

WIDTH = 8.6  # inches
DOTS = 110  # per inch
_COLOURS = 128


def png(figure: Figure, dots: int = DOTS) -> bytes:
    """Makes a PNG file of a figure: the same file in any Matplotlib version.

    A palette makes the file a quarter as large, which helps in a report with a curve for each of
    fifty seeds.
    """
    drawn, content = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dots)
    Image.open(drawn).convert("RGB").quantize(_COLOURS).save(content, "png", optimize=True)
    return content.getvalue()


def dress(panel: Axes, title: str, size: float = 10.0) -> None:
    """Gives a panel a faint grid, and a title of `size` points."""
    panel.set_title(title, loc="left", fontsize=size, pad=3)
    panel.grid(visible=True, alpha=0.25)
    panel.tick_params(labelsize=min(size, 9.0))


def percent() -> PercentFormatter:
    """Makes a formatter that writes shares of 0 to 1 in percent."""
    return PercentFormatter(1.0, symbol=" %")


def thousands(least: float = 0.0) -> FuncFormatter:
    """Makes a formatter that writes counts as 500, 1.5k and 1M.

    Args:
      least: smaller counts are written in full.
    """
    short = EngFormatter(sep="")
    return FuncFormatter(lambda x, _: f"{x:g}" if abs(x) < least else short(x))


def explain(figure: Figure, kinds: Sequence[Artist], columns: int = 5) -> None:
    """Adds a legend above the panels.

    Args:
      figure: a figure with a constrained layout.
      kinds: artists, each with a label.
      columns: number of columns of the legend.
    """
    place = "outside upper right"
    figure.legend(handles=kinds, loc=place, ncols=columns, fontsize=8, frameon=False)
