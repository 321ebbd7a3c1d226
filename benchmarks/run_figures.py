"""Draws the plots of docs/benchmarks.md."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks import run_tables

mpl.use("Agg")
Line = dict[str, Any]
_SIZE, _DOTS = (7.0, 4.0), 90  # inches; dots per inch
_PREFIX = "benchmarks_"


def draw(folder: Path, lines: Sequence[Line]) -> list[Path]:
    """Draws all plots for which there are lines, with one file per plot and device.

    Args:
      folder: folder for the PNG files.
      lines: lines of a file of results.

    Returns:
      The files.
    """
    results, written = run_tables.newest(lines), []
    folder.mkdir(parents=True, exist_ok=True)
    for device in dict.fromkeys(line["device"] for line in results):
        mine = [line for line in results if line["device"] == device]
        slug = re.sub(r"\W+", "-", device.lower()).strip("-")
        for name, plot in {
            "environment": _speeds(mine, ".environment", "robot_steps_per_s"),
            "training": _speeds(mine, "steps_per_second.training", "transitions_per_s"),
            "race": _race(mine),
        }.items():
            if plot is not None:
                path = folder / f"{_PREFIX}{name}_{slug}.png"
                # Matplotlib's version is left out, so that equal plots give equal files.
                plot.savefig(path, dpi=_DOTS, metadata={"Software": None})
                written.append(path)
    return written


def _figure() -> tuple[Figure, Axes]:
    plot = Figure(figsize=_SIZE, layout="constrained")
    axes = plot.subplots()
    axes.grid(visible=True, alpha=0.3)
    return plot, axes


def _speeds(lines: Sequence[Line], benchmark: str, key: str) -> Figure | None:
    """Plots speed over number of arenas, a curve per system; bars span slowest to fastest call."""
    curves: dict[str, list[Line]] = {}
    for line in run_tables.choose(lines, benchmark):
        if not line["benchmark"].startswith("robots_speed"):
            curves.setdefault(run_tables.label(line), []).append(line)
    if not any(len(points) > 1 for points in curves.values()):
        return None
    plot, axes = _figure()
    for name, points in curves.items():
        points.sort(key=lambda line: line["arenas"])
        speeds = [line[key] for line in points]
        # The speed of a call is inversely proportional to its time.
        low = [
            s * (1 - p["call_s"] / max(p["calls_s"])) for s, p in zip(speeds, points, strict=True)
        ]
        high = [
            s * (p["call_s"] / min(p["calls_s"]) - 1) for s, p in zip(speeds, points, strict=True)
        ]
        arenas = [line["arenas"] for line in points]
        style = "o--" if "peer" in points[0] else "o-"
        axes.errorbar(arenas, speeds, (low, high), fmt=style, ms=4, capsize=2, label=name)
    sizes = sorted({line["arenas"] for points in curves.values() for line in points})
    axes.set_xscale("log", base=2)
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
    words = key.removesuffix("_per_s").replace("_", " ")
    axes.set(yscale="log", xlabel="arenas", ylabel=f"{words} a second")
    axes.legend(fontsize=8)
    return plot


def _race(lines: Sequence[Line]) -> Figure | None:
    """Plots the share of targets reached over the seconds of training."""
    mine = [line for line in lines if "curve" in line]
    if not mine:
        return None
    plot, axes = _figure()
    trainers = list(dict.fromkeys(line["trainer"] for line in mine))
    for line in mine:
        name = line["trainer"]
        first = next(other for other in mine if other["trainer"] == name) is line
        axes.plot(
            *zip(*line["curve"], strict=True),
            "o-",
            ms=2,
            color=f"C{trainers.index(name)}",
            label=name if first else None,
        )
    for share in (0.90, 0.95):
        axes.axhline(share, color="0.5", lw=0.8, ls="--")
    axes.set(xscale="log", xlabel="seconds of training, compilation apart")
    axes.set(ylabel="targets reached")
    axes.legend(fontsize=8)
    return plot
