"""What the figures of a reproduction have in common: width, axes, what the paper says."""

from matplotlib.ticker import EngFormatter, FuncFormatter

from swarmjax.reproduce.measures import Axis

WIDTH = 8.6  # inches
PAPER = {"curriculum": 300, "baseline": 600}  # episodes: section 4, on Figure 6
AXES: dict[Axis, str] = {"episode": "episode of the run", "steps": "arena control steps"}


def thousands() -> FuncFormatter:
    """Writes episodes and steps as 500, 1.5k and 1M."""
    short = EngFormatter(sep="")
    return FuncFormatter(lambda x, _: f"{x:g}" if abs(x) < 10_000 else short(x))
