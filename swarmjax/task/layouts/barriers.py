"""Walls that stand between starts and targets: a trap, a fence, and a wall with a door.

A trap is a U-shaped wall that opens towards the robots, with the targets behind it. A fence starts
at one side of the arena and leaves a way around its end. A door joins two halls for one robot at a
time, with robots going both ways.
"""

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
    points,
    rows,
)
from swarmjax.task.placement import Gap, place, round_up, score_rectangles, score_things, split

Array = Any
_ROOM = 0.20  # m, before the mouth and behind the trap: one start or target, and spare space
_WAY = 0.14  # m, beside the trap: a hull (radius 0.045 m), 2 cm on either side, and 1 cm more
_ASIDE = 0.1  # largest offset of a fence or a wall from the middle, as a share of half the arena
_LEAST_WAY = 0.10  # m, around the end: a hull (radius 0.045 m), half a centimetre on either side
_JAMB = 0.10  # m, least length of wall on either side of the door


def draw_trap(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a trap.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `width` and `depth`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout. Starts and targets lie within the trap's width, so the straight line from a start
      to a target leads into the trap.
    """
    count = site.present.shape[0]
    position, shifts, targets, starts = split(uniforms, [2, 4, count, count])
    width, depth = site.numbers.width, site.numbers.depth
    half_x, half_y = site.half[0], site.half[1]
    room, way = round_up(_ROOM), round_up(_WAY)
    back = pick(position[0], room + depth - half_x, half_x - room - THICKNESS, xp)
    most = xp.maximum(half_y - way - THICKNESS - width // 2, 0)
    middle = pick(position[1], -most, most, xp)
    aside = xp.maximum(width // 2 - site.clear, 0)
    low, high = middle - aside, middle + aside
    before = points((site.clear - half_x, low), (back - depth - site.clear, high), shifts[:2], xp)
    behind = points(
        (back + THICKNESS + site.clear, low), (half_x - site.clear, high), shifts[2:], xp
    )
    open_ = xp.zeros(len(behind), xp.int32)
    target = place(behind, open_, targets, site.present, site.gaps.target, xp)[0]
    start = place_starts(site, before, target, starts, site.present, xp)
    return Drawn(_walls_of_trap(back, middle, width, depth, xp), np.ones(3, bool), start, target)


def _walls_of_trap(back: Array, middle: Array, width: Array, depth: Array, xp: Any) -> Array:
    """Returns the back wall and the two side walls, [3, 4] units."""
    thin, half = THICKNESS // 2, width // 2
    arm, length = half + thin, depth // 2
    return rows(
        (
            (back + thin, middle, thin, half + 2 * thin),
            (back - length, middle + arm, length, thin),
            (back - length, middle - arm, length, thin),
        ),
        xp,
    )


def _least_trap(demand: Demand) -> tuple[float, float]:
    thick = THICKNESS / 4096
    side = demand["depth"] + thick + 2 * _ROOM
    return side, demand["width"] + 2 * (thick + _WAY)


TRAP = ArenaLayout(
    draw=draw_trap,
    uniforms=lambda robots, _: 6 + 2 * robots,
    walls=lambda _: 3,
    reads=("width", "depth"),
    least=_least_trap,
    most_robots=4,
)


def draw_fence(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a fence.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `length`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout, with starts on one side and targets on the other. No start or target lies in the
      way around the end.
    """
    count = site.present.shape[0]
    position, shifts, targets, starts = split(uniforms, [1, 4, count, count])
    half_x, half_y = site.half[0], site.half[1]
    most = xp.floor(np.float32(_ASIDE) * half_x.astype(xp.float32)).astype(xp.int32)
    where, thin = pick(position[0], -most, most, xp), THICKNESS // 2
    end = half_y - site.numbers.length
    wall_y, wall_half = between(end, half_y)
    low, high = site.clear - half_y, half_y - site.clear
    near = where - thin - site.clear
    before = points((site.clear - half_x, low), (near, high), shifts[:2], xp)
    far = where + thin + site.clear
    behind = points((far, low), (half_x - site.clear, high), shifts[2:], xp)
    way_y, way_half = between(-half_y, end)
    way = rows(((where, way_y, thin, way_half),), xp)
    # This leaves room for a robot that parks on this side of its target, and for a robot that
    # passes.
    free = score_rectangles(behind, way, np.ones(1, bool), site.reach + 3 * site.hull, xp)
    target = place(behind, free, targets, site.present, site.gaps.target, xp)[0]
    start = place_starts(site, before, target, starts, site.present, xp)
    wall = rows(((where, wall_y, thin, wall_half),), xp)
    return Drawn(wall, np.ones(1, bool), start, target)


def _least_fence(demand: Demand) -> tuple[float, float]:
    # This is room for a row of starts on one side, a row of targets on the other, and the fence.
    side = 2 * 0.15 * (1 + demand["robots"] // 5) / (1 - _ASIDE) + THICKNESS / 4096
    return side, demand["length"] + _LEAST_WAY


FENCE = ArenaLayout(
    draw=draw_fence,
    uniforms=lambda robots, _: 5 + 2 * robots,
    walls=lambda _: 1,
    reads=("length",),
    least=_least_fence,
)


def draw_door(uniforms: Array, site: Site, xp: Any) -> Drawn:
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
        placed = place(hall[0], score, targets, there, site.gaps.target, xp)[0]
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


def _least_door(demand: Demand) -> tuple[float, float]:
    gap, apart = demand["gap"], demand["apart"]
    breadth = gap + 2 * _JAMB
    # This area has a square of 0.15 m for each start and each target, and free space near the door.
    area = demand["robots"] * 2 * 0.15**2 + 3.2 * apart**2
    return max(2 * (apart + 0.15), area / max(demand["breadth"], breadth)) / (1 - _ASIDE), breadth


DOOR = ArenaLayout(
    draw=draw_door,
    uniforms=lambda robots, _: 10 + 2 * robots,
    walls=lambda _: 2,
    reads=("gap", "apart"),
    least=_least_door,
)
