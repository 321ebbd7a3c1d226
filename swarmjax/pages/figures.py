"""What the figures of pages have in common: their files, their scales and their legends."""

import io
from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, PercentFormatter
from PIL import Image

WIDTH = 8.6  # inches
_DOTS = 110  # an inch


def png(figure: Figure, shades: int | None = None) -> bytes:
    """Makes a PNG file of a figure, without Matplotlib's version: the same figure, the same file.

    Args:
      figure: drawn.
      shades: colours of a palette of the figure's own, up to 256; None: the file has no palette.
    """
    content, small = io.BytesIO(), io.BytesIO()
    figure.savefig(content, format="png", dpi=_DOTS, metadata={"Software": None})
    if shades is None:
        return content.getvalue()
    image = Image.open(content).convert("RGB")
    # By coverage: by the median, a line that is short would take the colour of others.
    few = image.quantize(shades, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(small, format="png", optimize=True)
    return small.getvalue()


def percent() -> PercentFormatter:
    """Writes shares of 0 to 1 in percent."""
    return PercentFormatter(1.0, symbol=" %")


def thousands(least: float = 0.0) -> FuncFormatter:
    """Writes counts as 500, 1.5k and 1M.

    Args:
      least: below which a count is written in full.
    """
    short = EngFormatter(sep="")
    return FuncFormatter(lambda x, _: f"{x:g}" if abs(x) < least else short(x))


def explain(figure: Figure, kinds: Sequence[Artist], columns: int = 5) -> None:
    """Says above the panels what is what.

    Args:
      figure: with a constrained layout.
      kinds: artists with a label each.
      columns: of the legend.
    """
    place = "outside upper right"
    figure.legend(handles=kinds, loc=place, ncols=columns, fontsize=8, frameon=False)
