"""Two halls joined by a door for one robot at a time, with robots going both ways."""

from typing import Any

import numpy as np

from swarmjax.task.layouts.site import (
    THICKNESS,
    ArenaLayout,
    Demand,
    Drawn,
    Site,
    between,
    pick,
    place_starts,
    place_targets,
    points,
    rows,
)
from swarmjax.task.placement import Gap, round_up, score_things, split

Array = Any
_ASIDE = 0.1  # largest offset of the wall from the middle, as a share of half the arena
_JAMB = 0.10  # m, least length of wall on either side of the door


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a wall across the arena with a door in it.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `gap` (of the door) and `apart` (from targets to the door).
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout. Every second robot goes from left to right, the others from right to left.
    """
    count = site.present.shape[0]
    position, shifts, targets, starts = split(uniforms, [2, 8, count, count])
    half_x, half_y = site.half[0], site.half[1]
    most = xp.floor(np.float32(_ASIDE) * half_x.astype(xp.float32)).astype(xp.int32)
    where, thin = pick(position[0], -most, most, xp), THICKNESS // 2
    aside, jamb = site.numbers.gap // 2, round_up(_JAMB)
    most = xp.maximum(half_y - aside - jamb, 0)
    door = pick(position[1], -most, most, xp)
    halls = [_hall(site, where, side, shifts, xp) for side in (-1, 1)]
    away = Gap(site.numbers.apart, site.numbers.apart)  # kept even where there is little room
    middle = xp.stack([where, door])[None]
    right = np.arange(count) % 2 == 0
    going = (site.present & right, site.present & ~right)
    target = 0
    for hall, there in zip(reversed(halls), going, strict=True):
        score = score_things(hall[0], middle, np.ones(1, bool), away, xp)
        placed = place_targets(site, hall[0], score, targets, there, xp)
        target = xp.where(there[:, None], placed, target)
    start = 0
    for hall, there in zip(halls, going, strict=True):
        placed = place_starts(site, hall[1], target, starts, there, xp)
        start = xp.where(there[:, None], placed, start)
    upper, lower = between(door + aside, half_y), between(-half_y, door - aside)
    wall = rows(((where, upper[0], thin, upper[1]), (where, lower[0], thin, lower[1])), xp)
    return Drawn(wall, np.ones(2, bool), start, target)


def _hall(site: Site, where: Array, side: int, shifts: Array, xp: Any) -> tuple[Array, Array]:
    """Returns points for targets and for starts in the hall left (-1) or right (1) of the wall."""
    half_x, half_y = site.half[0], site.half[1]
    near = THICKNESS // 2 + site.clear
    low_x, high_x = (
        (site.clear - half_x, where - near) if side < 0 else (where + near, half_x - site.clear)
    )
    low, high = (low_x, site.clear - half_y), (high_x, half_y - site.clear)
    first = 0 if side < 0 else 4
    return (
        points(low, high, shifts[first : first + 2], xp),
        points(low, high, shifts[first + 2 : first + 4], xp),
    )


def _least(demand: Demand) -> tuple[float, float]:
    gap, apart = demand.numbers["gap"][1], demand.numbers["apart"][1]
    breadth = gap + 2 * _JAMB
    # This area has a square of 0.15 m for each start and each target, and free space near the door.
    area = demand.robots * 2 * 0.15**2 + 3.2 * apart**2
    return max(2 * (apart + 0.15), area / max(demand.breadth, breadth)) / (1 - _ASIDE), breadth


DOOR = ArenaLayout(
    draw=draw,
    uniforms=lambda robots, _: 10 + 2 * robots,
    walls=lambda _: 2,
    reads=("gap", "apart"),
    least=_least,
)
