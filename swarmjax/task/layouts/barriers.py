"""Walls that stand between starts and targets: a trap, a fence, a door, and two corridors.

A trap is a U-shaped wall that opens towards the robots, with the targets behind it. A fence starts
at one side of the arena and leaves a way around its end. A door joins two halls; one
robot at a time passes it, in either direction. Corridors are for one robot at a time. One has a
bay, where one robot lets the other pass. The other is a dead end, with targets one behind the
other.
"""

from typing import Any

import numpy as np

from swarmjax.task.layouts.site import (
    MARGIN_UNITS,
    THICKNESS,
    ArenaLayout,
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
_JAMB = 0.10  # m, least length of wall on either side of the door
_ENDS = 0.10  # m, length of the target area at either end of the corridor
_AHEAD = 0.20  # m, between one robot's target area and the other robot's start
_BEFORE = 0.08  # m, from the first target to the mouth of the corridor


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


TRAP = ArenaLayout(
    draw=draw_trap,
    uniforms=lambda robots, _: 6 + 2 * robots,
    walls=lambda _: 3,
    reads=("width", "depth"),
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


FENCE = ArenaLayout(
    draw=draw_fence,
    uniforms=lambda robots, _: 5 + 2 * robots,
    walls=lambda _: 1,
    reads=("length",),
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


DOOR = ArenaLayout(
    draw=draw_door,
    uniforms=lambda robots, _: 10 + 2 * robots,
    walls=lambda _: 2,
    reads=("gap", "apart"),
)


def draw_bay(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a corridor along x with a bay on its left.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `gap` (of the corridor), `width` (at the bay) and `length`
        (of the bay).
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout. The first robot starts at the left end and the second at the right end. Each has
      its target at the opposite end, behind the start of the other robot.
    """
    count = site.present.shape[0]
    place, starts, targets, aside = split(uniforms, [2, count, count, 2 * count])
    half_x, half_y = site.half[0], site.half[1]
    gap, recess = site.numbers.gap, site.numbers.width - site.numbers.gap
    most = xp.maximum(half_y - gap // 2 - recess - THICKNESS, 0)
    middle = pick(place[0], -most, most, xp)
    bay = pick(place[1], -(half_x // 4), half_x // 4, xp)
    # The first robot goes right, the second left; there is no third.
    way = xp.where(np.arange(count) % 2 == 0, 1, -1)
    end = half_x - site.clear
    last = round_up(_ENDS)
    target_x = way * pick(targets, end - last, end, xp)
    ahead = last + round_up(_AHEAD)
    start_x = -way * pick(starts, end - ahead - last, end - ahead, xp)
    most = xp.maximum(gap // 2 - site.hull - MARGIN_UNITS // 4, 0)
    off = middle + pick(aside, -most, most, xp)
    return Drawn(
        wall=_walls_of_bay(site, bay, middle, recess, xp),
        there=np.ones(4, bool),
        start=xp.stack([start_x, off[:count]], axis=-1),
        target=xp.stack([target_x, off[count:]], axis=-1),
    )


def _walls_of_bay(site: Site, bay: Array, middle: Array, recess: Array, xp: Any) -> Array:
    """Returns the walls [4, 4] (units): the right wall, then the left walls around the bay."""
    half_x, thin, aside = site.half[0], THICKNESS // 2, site.numbers.gap // 2
    along = site.numbers.length // 2
    left = between(-half_x, bay - along)
    right = between(bay + along, half_x)
    deep = (recess + 2 * thin + 1) // 2
    upper = middle + aside
    return rows(
        (
            (0 * bay, middle - aside - thin, half_x, thin),
            (left[0], upper + deep, left[1], deep),
            (right[0], upper + deep, right[1], deep),
            (bay, upper + recess + thin, along, thin),
        ),
        xp,
    )


BAY = ArenaLayout(
    draw=draw_bay,
    uniforms=lambda robots, _: 2 + 4 * robots,
    walls=lambda _: 4,
    reads=("gap", "width", "length"),
    most_robots=2,
)


def draw_row(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a corridor that ends at the arena's wall.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `gap` (of the corridor) and `apart` (of the targets).
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout. The first robot gets the deepest target. Robots start anywhere in the hall before
      the corridor.
    """
    count = site.present.shape[0]
    place, shift, starts = split(uniforms, [1, 2, count])
    half_x, half_y = site.half[0], site.half[1]
    gap, apart = site.numbers.gap, site.numbers.apart
    robots = xp.sum(site.present.astype(xp.int32), dtype=xp.int32)
    deepest = half_x - site.clear
    mouth = deepest - (robots - 1) * apart - int(_BEFORE * 4096)
    most = xp.maximum(half_y - gap // 2 - THICKNESS - 2 * site.hull - 2 * MARGIN_UNITS, 0)
    middle = pick(place[0], -most, most, xp)
    x = deepest - np.arange(count, dtype=np.int32) * apart
    target = xp.stack([x, 0 * x + middle], axis=-1)
    hall = points(
        (site.clear - half_x, site.clear - half_y),
        (mouth - site.clear, half_y - site.clear),
        shift,
        xp,
    )
    start = place_starts(site, hall, target, starts, site.present, xp)
    along, half = between(mouth, half_x)
    aside, thin = gap // 2 + THICKNESS // 2, THICKNESS // 2
    wall = rows(((along, middle + aside, half, thin), (along, middle - aside, half, thin)), xp)
    return Drawn(wall, np.ones(2, bool), start, target)


ROW = ArenaLayout(
    draw=draw_row,
    uniforms=lambda robots, _: 3 + robots,
    walls=lambda _: 2,
    reads=("gap", "apart"),
)
