"""Settings of a stage, and the arena size that its levels need."""

import functools
import math
import re
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from swarmjax import epuck
from swarmjax.config import ConfigError, Section, about, section, setting, show
from swarmjax.sim.config import SimConfig
from swarmjax.task import fixed_level, maps
from swarmjax.task.layouts import LAYOUTS, plots
from swarmjax.task.layouts.drawing import Kind
from swarmjax.task.layouts.site import NUMBERS, ArenaLayout
from swarmjax.task.placement import UNITS

# Area that a random level needs. A start and a target each take a square of 0.15 m (two hulls of
# 0.074 m side by side). An obstacle takes the square around its circumscribed circle, widened by a
# passage. In a passage, one robot has 13 mm to spare on either side. Along the walls, a border of
# half a passage stays free. For hulls larger than the e-puck's, both lengths grow with the hull.
DISC = 0.15  # m, edge of the square around the disc of a start or a target
PASSAGE = 0.10  # m; between obstacles, and between an obstacle and a wall
_DISC_PER_HULL, _PASSAGE_PER_HULL = 4.05, 2.7  # lengths per hull radius; as for the e-puck
FILLING = 0.4  # largest share of the free square that obstacles placed at random may take

BUILT_IN = ("random", "fixed", "map", *LAYOUTS)  # built-in kinds of levels
# Up to these numbers, squared lengths fit an int32 and points suffice; `plots` allows more.
_MOST_OBSTACLES, _MOST_ROBOTS, _LARGEST_SIDE = 112, 100, 4.0
_SMALLEST_CELL = 0.08  # m; a robot of 0.074 m with 3 mm on either side
_Length = float | tuple[float, float] | None


def complete(stage: dict[str, Any]) -> dict[str, Any]:
    """Fills in the settings of a stage that follow from its map, if it has one.

    Args:
      stage: plain data; `map` is a text or a list of its rows.

    Returns:
      The data, with `side`, `obstacles` and `level` if there is a map.

    Raises:
      ConfigError: the map is invalid.
    """
    text = stage.get("map")
    if not text:
        return stage
    rows = text.strip().split() if isinstance(text, str) else text
    rows = typing.cast(tuple[str, ...], section.convert(tuple[str, ...], rows, "stage.map"))
    cell = section.convert(float, stage.get("cell", StageConfig.cell), "stage.cell")
    try:
        found = _read_map(rows, typing.cast(float, cell))
    except ConfigError as error:
        raise ConfigError(f"stage {stage.get('name')}: {error}") from None
    derived = {"side": found.side, "obstacles": len(found.wall), "level": "map"}
    return {**stage, "map": list(rows), **derived}


@functools.lru_cache(maxsize=64)
def _read_map(rows: tuple[str, ...], cell: float) -> maps.Map:
    found = maps.read(rows, cell)
    if len(found.wall) > _MOST_OBSTACLES:
        raise ConfigError(
            f"map has walls of {len(found.wall)} rectangles: give walls of at most "
            f"{_MOST_OBSTACLES}; straight walls need the fewest rectangles."
        )
    return found


@dataclass(frozen=True, kw_only=True)
class StageConfig(Section):
    """Settings of one stage: number of robots, arena size and obstacles."""

    name: str = field(metadata=about("name of the stage, equal to the name of its file"))
    robots: int = field(metadata=about("number of robots", 1, 1024))
    side: float | tuple[float, float] = field(
        metadata=about("side of the square arena, m; from a range, each level draws it", 0.4, 40.0)
    )
    distance: _Length = setting(
        None,
        "length of the path from start to target around walls, m, or a range; null: any",
        0.05,
        50.0,
    )
    obstacles: int = setting(0, "number of obstacles; layouts except plots set it", 0, 256)
    obstacle_size: float = setting(
        0.10, "edge of the square boxes of level=random or plots, m", 0.02, 0.3
    )
    level: str = setting(
        "random",
        "random: new in every episode; fixed: always the same; map: walls from the key map, with "
        f"new starts and targets; {', '.join(LAYOUTS)}: new walls of this layout; or the name "
        "of an extension's level drawing",
    )
    layout: Literal["boxes", "fence"] = setting("boxes", "obstacles of level=fixed")
    map: tuple[str, ...] = setting(
        (),
        "rows of text that draw the arena: # wall, . floor, S start area, T target area, another "
        "small letter a robot's start, its capital the target; sets side, obstacles and level",
    )
    cell: float = setting(0.12, "edge of a map cell, m", _SMALLEST_CELL, 1.0)
    breadth: _Length = setting(
        None, "breadth of a layout's arena, m, or a range; null: equal to side", 0.2, 4.0
    )
    gap: _Length = setting(
        None, "free width of a door or a corridor, m, or a range", _SMALLEST_CELL, 1.0
    )
    width: _Length = setting(
        None, "free width of a trap, or of a corridor at its bay, m, or a range", 0.1, 2.0
    )
    depth: _Length = setting(None, "depth of a trap, m, or a range", 0.05, 2.0)
    length: _Length = setting(None, "length of a fence or a bay, m, or a range", 0.1, 4.0)
    radius: _Length = setting(None, "radius of the circle of starts, m, or a range", 0.1, 1.9)
    apart: _Length = setting(
        None, "distance (m, or a range) between targets, or from targets to a door", 0.05, 1
    )
    cells: int | None = setting(None, "cells along a side of level=maze or blocks", 2, 8)

    def _check(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", self.level):
            raise ConfigError(
                f"level is {show(self.level)}: give {' or '.join(BUILT_IN)}, or the name of an "
                "extension's level drawing."
            )
        if not re.fullmatch(r"[\w-]+", self.name):
            raise ConfigError(f"name is {show(self.name)}: give letters, digits, _ and - only.")
        if self.level != "plots" or self.distance is not None:
            self._check_number()
        self._check_fixed()
        self._check_keys(LAYOUTS.get(self.level))
        if self.level in LAYOUTS:
            self._check_size(LAYOUTS[self.level])
        elif self.level == "map" or self.map:
            self._check_map()
        elif self.sides[0] < (least := smallest_side(self)):
            raise ConfigError(
                f"side is {show(self.side)}, too small for robots={self.robots}, "
                f"obstacles={self.obstacles}, obstacle_size={show(self.obstacle_size)}: "
                f"give at least {math.ceil(100 * least) / 100}."
            )

    def _check_number(self) -> None:
        """Refuses numbers too large for levels that place objects or starts one after the other."""
        most = {"robots": _MOST_ROBOTS, "side": _LARGEST_SIDE, "obstacles": _MOST_OBSTACLES}
        for key, limit in most.items():
            if (self.sides[1] if key == "side" else getattr(self, key)) > limit:
                reason, other = f"level is {self.level}", "level=plots"
                if self.level == "plots":
                    reason, other = f"distance is {show(self.distance)}", "no distance"
                raise ConfigError(
                    f"{key} is {show(getattr(self, key))}, but {reason}: give at most {limit:g}, "
                    f"or {other}."
                )

    def _check_fixed(self) -> None:
        if self.layout == "fence" and self.level != "fixed":
            raise ConfigError(f"layout is fence, but level is {self.level}: give level=fixed.")
        if self.level != "fixed":
            return
        if isinstance(self.side, tuple):
            raise ConfigError(f"side is {show(self.side)}, but level is fixed: give one number.")
        if self.distance is not None:
            raise ConfigError(
                f"distance is {show(self.distance)}, but level is fixed, which sets the starts "
                "itself: leave distance out."
            )
        most = {
            "robots": fixed_level.most_robots(self.side),
            "obstacles": len(fixed_level.BOXES),
        }
        for key, limit in most.items():
            if getattr(self, key) > limit:
                raise ConfigError(
                    f"{key} is {getattr(self, key)}, but the fixed level of a {self.side:g} m "
                    f"arena has room for {limit}: give at most {limit}."
                )

    def _check_map(self) -> None:
        drawn = self.drawn_map
        if drawn is None or self.level != "map":
            raise ConfigError(
                f"level is {self.level}, but map is {'given' if self.map else 'missing'}: give "
                "both level=map and a map, or neither."
            )
        pairs, areas = len(drawn.pair), len(drawn.start)
        if self.robots < pairs or (self.robots > pairs and not areas):
            without = "" if areas else " and no areas S and T"
            raise ConfigError(
                f"robots is {self.robots}, but map has letters for {pairs} robots{without}: give "
                f"{'at least ' if areas else ''}{pairs}."
            )

    def _check_keys(self, layout: ArenaLayout | None) -> None:
        """Refuses sizes that the level does not use, and asks for those that it needs."""
        needed = () if layout is None else layout.reads
        optional = () if layout is None or layout.square else ("breadth",)
        for key in (*NUMBERS, "breadth", "cells"):
            given = getattr(self, key)
            if given is not None and key not in (*needed, *optional):
                raise ConfigError(
                    f"{key} is {show(given)}, but level is {self.level}, which has no {key}: leave "
                    f"{key} out."
                )
            if given is None and key in needed:
                raise ConfigError(
                    f"{key} is missing: level={self.level} needs {' and '.join(needed)}."
                )

    def _check_size(self, layout: ArenaLayout) -> None:
        assert self.kind is not None
        object.__setattr__(self, "obstacles", self.kind.walls)
        if self.robots > layout.most_robots:
            raise ConfigError(
                f"robots is {self.robots}, but level={self.level} has room for "
                f"{layout.most_robots}: give at most {layout.most_robots}."
            )
        if self.level == "plots" and self.sides[0] < (least := smallest_plots(self)):
            raise ConfigError(
                f"side is {show(self.side)}, too small for robots={self.robots} and "
                f"obstacles={self.obstacles} on plots: give at least {math.ceil(10 * least) / 10}."
            )

    @property
    def kind(self) -> Kind | None:
        """The settings of the layout that are fixed at compile time; None without a layout."""
        if self.level not in LAYOUTS:
            return None
        cells = self.obstacles if self.level == "plots" else self.cells or 0
        return Kind(self.level, cells, self.breadth is not None)

    @property
    def laid_out(self) -> tuple[Kind, dict[str, Any]] | None:
        """The entry for `drawing.stack`, lengths in 1/4096 m; None without a layout."""
        if self.kind is None:
            return None
        ends = [_ends(getattr(self, key) or 0.0) for key in NUMBERS]
        if self.level == "plots":
            ends[NUMBERS.index("width")] = _ends(self.obstacle_size)
        return self.kind, {
            "side": _whole(self.side),
            "breadth": [0, 0] if self.breadth is None else _whole(self.breadth),
            "low": [round(low * UNITS) for low, _ in ends],
            "high": [round(high * UNITS) for _, high in ends],
        }

    @property
    def drawn_map(self) -> maps.Map | None:
        """The stage's map; None without one."""
        return _read_map(self.map, self.cell) if self.map else None

    @property
    def distance_units(self) -> tuple[int, int]:
        """The shortest and longest path from start to target, 1/4096 m; 0 if any will do."""
        low, high = _ends(self.distance or 0.0)
        return round(low * UNITS), round(high * UNITS)

    @property
    def sides(self) -> tuple[float, float]:
        """The smallest and the largest side of the arena, m."""
        return _ends(self.side)


def passage(hull: float) -> float:
    """Returns the width of passages between obstacles for robots of this hull radius, m."""
    return max(PASSAGE, _PASSAGE_PER_HULL * hull)


def smallest_side(stage: StageConfig, hull: float = epuck.HULL_RADIUS) -> float:
    """Returns the smallest side of an arena that has room for a level of the stage.

    The free square (side - 0.10)^2 must hold two squares of 0.15^2 for each robot. It must also
    hold a square of (obstacle_size * sqrt(2) + 0.10)^2 for each obstacle. This leaves more than a
    passage on either side of any single obstacle.

    A random level places its obstacles one after the other. The obstacles may take at most the
    share FILLING of the free square. Discs placed this way leave no room for another one at 0.547
    of the area (Feder 1980), 0.70 of what a square grid of discs covers. Walls lower this share.

    Args:
      stage: the stage; its `side` is not read.
      hull: radius of the robots, m. The numbers above hold for hulls up to the e-puck's.

    Returns:
      The side, m.
    """
    free, disc = passage(hull), max(DISC, _DISC_PER_HULL * hull)
    pitch = stage.obstacle_size * math.sqrt(2) + free
    area = stage.robots * 2 * disc**2 + stage.obstacles * pitch**2
    if stage.level != "fixed":  # an extension's drawing starts from a random level
        area = max(area, stage.obstacles * pitch**2 / FILLING)
    return free + math.sqrt(area)


def smallest_plots(stage: StageConfig) -> float:
    """Returns the smallest side, m, of an arena whose plots hold e-pucks and boxes."""
    box = stage.obstacle_size + PASSAGE if stage.obstacles else 0.0
    return plots.along(stage.robots, stage.obstacles) * max(DISC, box)


def make_room(sim: SimConfig, stages: Sequence[StageConfig]) -> SimConfig:
    """Sets how many robots and obstacles to compile for, unless the settings give the numbers.

    Args:
      sim: the settings.
      stages: stages that must fit.

    Returns:
      The settings with both numbers: by default at least 5 robots and 4 obstacles, so that the
      stages of a curriculum share a program and its checkpoints.
    """
    robots = max([sim.robots, *(stage.robots for stage in stages)])
    obstacles = max([sim.obstacles, *(stage.obstacles for stage in stages)])
    return replace(
        sim,
        max_robots=robots if sim.max_robots is None else sim.max_robots,
        max_obstacles=obstacles if sim.max_obstacles is None else sim.max_obstacles,
    )


def _whole(length: float | tuple[float, float]) -> list[int]:
    """Rounds an extent to an even number of units, so that its half is a whole number of units."""
    return [2 * round(end * UNITS / 2) for end in _ends(length)]


def _ends(side: float | tuple[float, float]) -> tuple[float, float]:
    return side if isinstance(side, tuple) else (side, side)
