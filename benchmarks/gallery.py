"""Makes animations of levels: `python -m benchmarks.gallery suite=worlds out=DIR policy=FILE`.

The command runs one level of each cell in MuJoCo's C engine and draws the level from above as an
animated WebP. Walls and boxes are black. Robots are discs with a line to the front. Targets are
circles. A robot gets a white dot when it has arrived. The policy drives the robots of a cell,
unless `who` names a baseline of `benchmarks.baselines` for this cell.
"""

import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from benchmarks import baselines, key_value
from swarmjax import command, epuck, policy_file
from swarmjax.config import ConfigError, Section, about, show
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate import cells, engine_c, trials
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.policy import Policy
from swarmjax.task.config import TaskConfig
from swarmjax.task.level import Level
from swarmjax.task.stage_files import load_levels

SIZE = 280  # edge of a picture, pixels
_FINE = 3  # pictures are drawn this many times larger and scaled down, for smooth edges
_MARGIN = 0.03  # m, around the arena
_PAUSE = 1200  # ms; the last picture is shown this long
# Matplotlib's colours C0 to C9.
_COLOURS = (
    *("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd"),
    *("#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf"),
)


@dataclass(frozen=True, kw_only=True)
class GalleryConfig(Section):
    """Settings: which levels to draw, and what drives the robots."""

    suite: str = field(default="worlds", metadata=about("a name of configs/suites/, or a file"))
    out: str = field(metadata=about("folder of the pictures, one for each cell"))
    policy: str = field(metadata=about("policy file that drives all cells not in `who`"))
    who: tuple[str, ...] = field(
        default=("trap:bug2", "fence:bug2", "maze:bug2"),
        metadata=about("CELL:BASELINE, baselines that drive instead of the policy"),
    )
    cells: tuple[str, ...] = field(default=(), metadata=about("cells by name; none: all of them"))
    level: int = field(default=0, metadata=about("which level of each cell", 0, MAX_COUNT))
    steps: int = field(
        default=1500, metadata=about("control steps at most", 1, 100_000, reason="raise steps")
    )
    every: int = field(default=10, metadata=about("control steps from picture to picture", 1, 1000))
    pace: int = field(default=80, metadata=about("time that a picture is shown for, ms", 10, 10000))

    def _check(self) -> None:
        for word in self.who:
            if word.partition(":")[2] not in baselines.NAMES:
                names = ", ".join(baselines.NAMES)
                raise ConfigError(f"who is {show(word)}: give CELL:NAME, NAME one of {names}.")


class Moment(NamedTuple):
    """The robots' poses at one moment.

    Attributes:
      pose: [R, 3] x (m), y (m), yaw (rad).
      arrived: [R] whether each robot has arrived.
    """

    pose: np.ndarray
    arrived: np.ndarray


def drive(settings: GalleryConfig, cell: Cell, who: str | None) -> tuple[Level, list[Moment]]:
    """Runs one level.

    Args:
      settings: Settings of the gallery.
      cell: Cell of the level.
      who: Baseline that drives; None for the policy.

    Returns:
      The level, and its moments from the start to the end.
    """
    config, trained = _evaluation(settings, who)
    mine = trials.specialise(config, cell, config.policy)
    judge = evaluate_judge.load(mine, trained, cell.half)
    level = cells.split(cell.levels)[settings.level]
    arenas = engine_c.start(judge, [level])
    driver = (baselines.controller(who, judge) if who else None) or engine_c.ByPolicy(judge)
    memory, frames = driver.init(arenas), [_frame(arenas)]
    for step in range(1, settings.steps + 1):
        memory, action = driver.act(memory, arenas)
        arenas = engine_c.step(judge, arenas, action)
        over = bool(arenas.outcome.arrived.all())
        if over or step % settings.every == 0:
            frames.append(_frame(arenas))
        if over:
            break
    return level, frames


def _frame(arenas: engine_c.Arenas) -> Moment:
    return Moment(np.array(arenas.pose[0]), np.array(arenas.outcome.arrived[0]))


def _evaluation(settings: GalleryConfig, who: str | None) -> tuple[EvaluateConfig, Policy]:
    """Reads the judge's settings, and a policy that drives or only gives the range of commands."""
    words = [f"suite={settings.suite}"]
    if who is None:
        words.append(f"policy={settings.policy}")
        return load_levels(EvaluateConfig, words), policy_file.read(settings.policy)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.npz"
        baselines.write(path, *baselines.POLICIES.get(who, baselines.POLICIES["still"]))
        config = load_levels(EvaluateConfig, [*words, f"policy={path}"])
        return config, policy_file.read(str(path))


def picture(level: Level, frame: Moment) -> Image.Image:
    """Draws one moment, `SIZE` pixels wide and high.

    Args:
      level: The level with everything that does not move.
      frame: The robots' poses.

    Returns:
      The picture.
    """
    edge = SIZE * _FINE
    scale = edge / (float(level.side) + 2 * _MARGIN)
    image = Image.new("RGB", (edge, edge), "white")
    pen = ImageDraw.Draw(image)
    half = 0.5 * float(level.side)
    pen.rectangle(
        [*_pixel(-half, half, scale), *_pixel(half, -half, scale)], outline="black", width=4
    )
    for box in level.obstacle[level.obstacle_present]:
        pen.polygon([_pixel(x, y, scale) for x, y in _corners(box)], fill="black")
    for robot in np.flatnonzero(level.present):
        _draw_robot(pen, level, frame, int(robot), scale)
    return image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def _draw_robot(
    pen: ImageDraw.ImageDraw, level: Level, frame: Moment, robot: int, scale: float
) -> None:
    colour = _COLOURS[robot % len(_COLOURS)]
    x, y, yaw = map(float, frame.pose[robot])
    goal_x, goal_y = map(float, level.target[robot])
    target = _pixel(goal_x, goal_y, scale)
    pen.circle(target, TaskConfig().target_radius * scale, outline=colour, width=4)
    pen.circle(_pixel(x, y, scale), epuck.HULL_RADIUS * scale, fill=colour)
    nose = (x + epuck.HULL_RADIUS * math.cos(yaw), y + epuck.HULL_RADIUS * math.sin(yaw))
    pen.line([_pixel(x, y, scale), _pixel(*nose, scale)], fill="white", width=5)
    if frame.arrived[robot]:
        pen.circle(_pixel(x, y, scale), 0.4 * epuck.HULL_RADIUS * scale, fill="white")


def _pixel(x: float, y: float, scale: float) -> tuple[float, float]:
    """Converts metres from the centre (y up) to pixels from the corner (y down)."""
    middle = 0.5 * SIZE * _FINE
    return middle + x * scale, middle - y * scale


def _corners(box: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yields the corners of a box [5], in order."""
    x, y, yaw, half_x, half_y = map(float, box)
    for along, across in ((1, 1), (1, -1), (-1, -1), (-1, 1)):
        ahead, aside = along * half_x, across * half_y
        yield (
            x + ahead * math.cos(yaw) - aside * math.sin(yaw),
            y + ahead * math.sin(yaw) + aside * math.cos(yaw),
        )


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = key_value.load(GalleryConfig, arguments)
    drivers = dict(word.split(":") for word in settings.who)
    out = Path(settings.out)
    out.mkdir(parents=True, exist_ok=True)
    for cell in cells.load(_evaluation(settings, "still")[0]).cells:
        if settings.cells and cell.name not in settings.cells:
            continue
        level, frames = drive(settings, cell, drivers.get(cell.name))
        images = [picture(level, frame) for frame in frames]
        shown = [settings.pace] * (len(images) - 1) + [_PAUSE]
        file = out / f"{cell.name}.webp"
        packed = {"quality": 40, "method": 6, "minimize_size": True}
        images[0].save(
            file, save_all=True, append_images=images[1:], duration=shown, loop=0, **packed
        )
        told = f"{frames[-1].arrived.sum()} of {level.present.sum()} robots arrived"
        sys.stdout.write(f"{file}: {len(images)} pictures, {told}, {file.stat().st_size:,} bytes\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("gallery", main, GalleryConfig))
