"""A stage: its settings, the room that a level needs, and grids of stages."""

import functools
import itertools
import math
import re
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from swarmjax.config import ConfigError, Section, about, section, show
from swarmjax.sim.config import SimConfig
from swarmjax.task import maps

# The room that a random level asks for. A start and a target each take a square of 0.15 m (two
# hulls of 0.074 m side by side); an obstacle takes the square about its circumscribed circle,
# widened by a passage through which one robot fits with 13 mm to spare on either side; along the
# walls a border of half a passage stays free.
DISC = 0.15  # m, edge of the square about the disc of a start or a target


PASSAGE = 0.10  # m; between obstacles, and between an obstacle and a wall


FILLING = 0.4  # boxes per square of a grid that random placing surely reaches


BUILT_IN = ("random", "fixed", "map")  # ways of drawing levels
_OR = "or the name of a drawing of extensions"


_MOST_OBSTACLES = 32
_SMALLEST_CELL = 0.08  # m; a robot of 0.074 m and 3 mm on either side


def complete(stage: dict[str, Any]) -> dict[str, Any]:
    """Adds to a stage with a map what the map says.

    Args:
        stage: plain data; `map` is a text, or its rows.

    Returns:
        The data, with `side`, `obstacles` and `level` if there is a map.

    Raises:
        ConfigError: the map is unsound.
    """
    text = stage.get("map")
    if not text:
        return stage
    rows = text.strip().split() if isinstance(text, str) else text
    rows = section.convert(tuple[str, ...], rows, "stage.map")
    cell = section.convert(float, stage.get("cell", StageConfig.cell), "stage.cell")
    try:
        found = _read_map(typing.cast(tuple[str, ...], rows), typing.cast(float, cell))
    except ConfigError as error:
        raise ConfigError(f"stage {stage.get('name')}: {error}") from None
    said = {"side": found.side, "obstacles": len(found.wall), "level": "map"}
    return {**stage, "map": list(typing.cast(tuple[str, ...], rows)), **said}


@functools.lru_cache(maxsize=64)
def _read_map(rows: tuple[str, ...], cell: float) -> maps.Map:
    found = maps.read(rows, cell)
    if len(found.wall) > _MOST_OBSTACLES:
        raise ConfigError(
            f"map has walls of {len(found.wall)} rectangles: give at most {_MOST_OBSTACLES}; "
            "straight walls take the fewest."
        )
    return found


_Cell = tuple[int, int, float | tuple[float, float]]  # robots, obstacles, side


@dataclass(frozen=True, kw_only=True)
class StageConfig(Section):
    """One stage: how many robots, how large an arena, which obstacles."""

    name: str = field(metadata=about("name of the stage, that of its file"))
    robots: int = field(metadata=about("active robots", 1, 100))
    side: float | tuple[float, float] = field(
        metadata=about("side of the square arena, m; a range: drawn anew for each level", 0.4, 4.0)
    )
    obstacles: int = field(default=0, metadata=about("obstacles", 0, _MOST_OBSTACLES))
    obstacle_size: float = field(
        default=0.10, metadata=about("edge of the square boxes of a random level, m", 0.02, 0.3)
    )
    level: str = field(
        default="random",
        metadata=about(
            "random: a new one every episode; fixed: always the same; map: the walls of map, with "
            "new starts and targets; or a drawing of extensions"
        ),
    )
    layout: Literal["boxes", "fence"] = field(
        default="boxes", metadata=about("obstacles of a fixed level")
    )
    map: tuple[str, ...] = field(
        default=(),
        metadata=about(
            "rows of the arena as text: # wall, . floor, S start area, T target area, a letter and "
            "its capital for one robot; it says side, obstacles and level"
        ),
    )
    cell: float = field(
        default=0.12, metadata=about("edge of a letter of map, m", _SMALLEST_CELL, 1.0)
    )

    def _check(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", self.level):
            raise ConfigError(f"level is {show(self.level)}: give {' or '.join(BUILT_IN)}, {_OR}.")
        if not re.fullmatch(r"[\w-]+", self.name):
            raise ConfigError(f"name is {show(self.name)}: give letters, digits, _ and - only.")
        if self.layout == "fence" and self.level != "fixed":
            raise ConfigError(f"layout is fence, but level is {self.level}: give level=fixed.")
        if self.layout == "fence" and self.obstacles < 1:
            raise ConfigError("obstacles is 0, but layout is fence: give 1 or more.")
        if self.level == "fixed" and isinstance(self.side, tuple):
            raise ConfigError(f"side is {show(self.side)}, but level is fixed: give one number.")
        self._check_map()
        least = 0.0 if self.map else smallest_side(self)
        if self.sides[0] < least:
            raise ConfigError(
                f"side is {show(self.side)}, too small for robots={self.robots}, "
                f"obstacles={self.obstacles}, obstacle_size={show(self.obstacle_size)}: "
                f"give at least {math.ceil(100 * least) / 100}."
            )

    def _check_map(self) -> None:
        if bool(self.map) != (self.level == "map"):
            raise ConfigError(
                f"level is {self.level}, but map is {'given' if self.map else 'missing'}: give "
                "both level=map and a map, or neither."
            )
        if not self.map:
            return
        drawn = self.drawn_map
        assert drawn is not None
        said = {"side": drawn.side, "obstacles": len(drawn.wall)}
        for key, value in said.items():
            if getattr(self, key) != value:
                raise ConfigError(
                    f"{key} is {show(getattr(self, key))}, but map says {value}: leave {key} out."
                )
        self._check_robots(drawn)

    def _check_robots(self, drawn: maps.Map) -> None:
        pairs = len(drawn.pair)
        if self.robots < pairs:
            raise ConfigError(
                f"robots is {self.robots}, but map has letters for {pairs}: give at least {pairs}."
            )
        if self.robots > pairs and not len(drawn.start):
            raise ConfigError(
                f"robots is {self.robots}, but map has letters for {pairs} and no S and T: give "
                f"{pairs}, or areas S and T for the others."
            )

    @property
    def drawn_map(self) -> maps.Map | None:
        """The map; None without one."""
        return _read_map(self.map, self.cell) if self.map else None

    @property
    def sides(self) -> tuple[float, float]:
        """The smallest and the largest side of the arena, m."""
        return _ends(self.side)


def smallest_side(stage: StageConfig) -> float:
    """Side of the smallest arena in which a level of the stage can be laid out.

    The free square (side - 0.10)^2 must hold two squares of 0.15^2 for each robot and one of
    (obstacle_size * sqrt(2) + 0.10)^2 for each obstacle, which leaves more than a passage on
    either side of any one obstacle. Those of a random level, placed one after the other, may fill
    FILLING of it: discs that are placed so jam at 0.547 of the area (Feder 1980), which is 0.70 of
    a square grid of them, and the walls cut some off.

    Args:
        stage: the stage; its `side` is not read.

    Returns:
        The side, m.
    """
    random = stage.level != "fixed"  # a drawing of an extension changes a random level
    return _smallest_side(stage.robots, stage.obstacles, stage.obstacle_size, random=random)


def make_room(sim: SimConfig, stages: Sequence[StageConfig]) -> SimConfig:
    """Say how many robots and obstacles are compiled in, where the settings leave it open.

    Args:
        sim: the settings.
        stages: that must fit.

    Returns:
        The settings with numbers for both: 5 and 4 at least, so that a curriculum's stages share a
        program and its checkpoints.
    """
    robots = max([sim.robots, *(stage.robots for stage in stages)])
    obstacles = max([sim.obstacles, *(stage.obstacles for stage in stages)])
    return replace(
        sim,
        max_robots=robots if sim.max_robots is None else sim.max_robots,
        max_obstacles=obstacles if sim.max_obstacles is None else sim.max_obstacles,
    )


def _smallest_side(robots: int, obstacles: int, obstacle_size: float, *, random: bool) -> float:
    pitch = obstacle_size * math.sqrt(2) + PASSAGE
    area = robots * 2 * DISC**2 + obstacles * pitch**2
    if random:
        area = max(area, obstacles * pitch**2 / FILLING)
    return PASSAGE + math.sqrt(area)


def _ends(side: float | tuple[float, float]) -> tuple[float, float]:
    return side if isinstance(side, tuple) else (side, side)


@dataclass(frozen=True, kw_only=True)
class GridConfig(Section):
    """Stages: every number of robots with every number of obstacles in every arena."""

    robots: tuple[int, ...] = field(metadata=about("active robots", 1, 100))
    obstacles: tuple[int, ...] = field(default=(0,), metadata=about("obstacles", 0, 32))
    side: tuple[float | tuple[float, float], ...] = field(
        metadata=about("sides of the square arena, m, or ranges that they are drawn from", 0.4, 4.0)
    )
    obstacle_size: float = field(
        default=0.10, metadata=about("edge of the square boxes, m", 0.02, 0.3)
    )

    def _check(self) -> None:
        for key in ("robots", "obstacles", "side"):
            if not getattr(self, key):
                raise ConfigError(f"{key} is []: give at least one number.")
        if not self.stages():
            least = min(self._least(cell) for cell in self._cells())
            raise ConfigError(
                f"side is {show(self.side)}, which leaves no cell: the smallest swarm with the "
                f"fewest obstacles needs {math.ceil(100 * least) / 100}."
            )

    def stages(self) -> tuple[StageConfig, ...]:
        """Make the stages, the side changing fastest and the robots slowest.

        Cells whose arena is too small for what is in them are left out.
        """
        cells = [cell for cell in self._cells() if _ends(cell[2])[0] >= self._least(cell)]
        return tuple(
            StageConfig(
                name=_cell_name(*cell),
                robots=cell[0],
                obstacles=cell[1],
                side=cell[2],
                obstacle_size=self.obstacle_size,
            )
            for cell in cells
        )

    def _cells(self) -> Iterator[_Cell]:
        return itertools.product(self.robots, self.obstacles, self.side)

    def _least(self, cell: _Cell) -> float:
        return _smallest_side(cell[0], cell[1], self.obstacle_size, random=True)


def _cell_name(robots: int, obstacles: int, side: float | tuple[float, float]) -> str:
    """Name a cell of a grid by its numbers, lengths in cm, as r5-o3-s120 or r5-o3-s50-120."""
    ends = side if isinstance(side, tuple) else (side,)
    lengths = "-".join(f"{100 * length:.6g}".replace(".", "_") for length in ends)
    return f"r{robots}-o{obstacles}-s{lengths}"
