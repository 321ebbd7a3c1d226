"""Draws small pictures of the levels that a run practises now, one row per stage."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patches, transforms
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmjax import epuck
from swarmjax.config import ConfigError
from swarmjax.report import rows as report_rows
from swarmjax.run import practised
from swarmjax.run.settings import TrainConfig
from swarmjax.task import level
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.stage_config import BUILT_IN

_MOST_ROWS = 12  # stages drawn


def read(run: Path, config: TrainConfig) -> list[list[dict[str, Any]]] | None:
    """Reads which levels the first seed of a run practised at its newest checkpoint.

    Args:
      run: the run directory.
      config: the run's settings.

    Returns:
      The best levels of each stage, as `practised.best` lists them; None without a buffer.

    Raises:
      ConfigError: if the file is damaged.
    """
    path = run / practised.FILE
    if not config.curriculum.levels.is_on or not path.exists():
        return None
    found = report_rows.read_object(path).get("levels")
    try:
        first = [[_checked(each) for each in of_stage] for of_stage in found[0]]  # pyright: ignore
    except (TypeError, KeyError, IndexError, ValueError):
        first = []
    if len(first) != len(config.stage):
        raise ConfigError(f"{path} holds no levels of {len(config.stage)} stages: it is damaged.")
    return first


def _checked(raw: dict[str, Any]) -> dict[str, Any]:
    numbers = np.array(raw["numbers"], np.float32)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise ValueError
    return {key: float(raw[key]) for key in ("score", "episodes", "successes", "generation")} | {
        "numbers": numbers
    }


def draw(best: list[list[dict[str, Any]]], config: TrainConfig) -> Figure | None:
    """Draws the practised levels, each with its success and its score.

    Args:
      best: the levels, as `read` returns them.
      config: the run's settings.

    Returns:
      The figure; None if every level comes from an extension, which cannot be drawn here.
    """
    sizes = config.sim.robots, config.sim.obstacles
    spacing = Spacing(*sizes, config.robot.hull_radius, config.task.target_radius)
    shown = [
        (stage, of_stage)
        for stage, of_stage in zip(config.stage, best, strict=True)
        if of_stage and stage.level in BUILT_IN
    ][:_MOST_ROWS]
    if not shown:
        return None
    figure = Figure(figsize=(2.1 * practised.BEST, 2.3 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), practised.BEST, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for row, (stage, of_stage) in zip(axes, shown, strict=True):
        arrays = task_stage.single(stage)
        for axis, each in zip(row, of_stage, strict=False):
            drawn = level.sample(each["numbers"], arrays, spacing, np)
            draw_level(axis, drawn, config.task.target_radius)
            axis.set_title(f"{stage.name}\n{_told(each)}", fontsize=7)
    return figure


def _told(one: dict[str, Any]) -> str:
    share = 100 * one["successes"] / max(one["episodes"], 1.0)
    born = f", mutation {one['generation']:.0f}" if one["generation"] else ""
    return f"{share:.0f} % of {one['episodes']:.0f}, score {one['score']:.3g}{born}"


def draw_level(axis: Axes, drawn: Level, target_radius: float) -> None:
    """Draws a level from above: walls and boxes in black, robots as discs, targets as circles.

    Args:
      axis: to draw on.
      drawn: the level of one arena, in NumPy.
      target_radius: radius of the arrival zone, m.
    """
    half = 0.5 * float(drawn.side)
    axis.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
    axis.add_patch(patches.Rectangle((-half, -half), 2 * half, 2 * half, fill=False, linewidth=1.5))
    for x, y, yaw, half_x, half_y in drawn.obstacle[drawn.obstacle_present]:
        turn = transforms.Affine2D().rotate(float(yaw)).translate(float(x), float(y))
        corner = (-float(half_x), -float(half_y))
        box = patches.Rectangle(corner, 2 * float(half_x), 2 * float(half_y), color="black")
        box.set_transform(turn + axis.transData)
        axis.add_patch(box)
    for i in np.flatnonzero(drawn.present):
        colour, start, target = f"C{i % 10}", drawn.start[i, :2], drawn.target[i]
        axis.add_patch(patches.Circle(tuple(start), epuck.HULL_RADIUS, color=colour))
        axis.add_patch(patches.Circle(tuple(target), target_radius, color=colour, fill=False))
