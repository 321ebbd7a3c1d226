"""`cover`: the robots together see the whole floor.

The floor is a grid of cells; those on which no robot can stand do not count. A cell is seen once
its centre has been within infrared range of a hull. All robots share the map of what has been seen,
and the target of each is the nearest unseen cell (Yamauchi 1998, "Frontier-Based Exploration Using
Multiple Robots").
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from swarmjax.task.goals.goal import Goal, Measure, Turn
from swarmjax.task.level import Level
from swarmjax.task.observation import View

Array = Any
CELLS = 16  # along a side; a cell of an arena of 1.2 m has 7.5 cm, the width of an e-puck
ENOUGH = 0.95  # share of the floor that counts as all of it; corners between boxes may stay unseen


class Floor(NamedTuple):
    """The map of the floor.

    Attributes:
      left: [..., C] whether the cell has not been seen yet, bool.
      size: [...] number of cells on which a robot can stand.
    """

    left: Array
    size: Array


class Cover(Goal):
    """All robots together see the floor."""

    measures: Mapping[str, Measure] = {"floor_seen": Measure("floor seen", "%", is_good=True)}

    def begin(self, level: Level) -> tuple[Floor, Array]:
        """Makes the map; see `Goal.begin`."""
        cell = _cells(level.side)
        free = _clearance(cell, level) >= self.sizes.hull_radius
        floor = Floor(free, free.sum(axis=-1))
        return floor, _nearest(free, cell, level.start[..., :2], level)

    def advance(self, state: Floor, level: Level, view: View) -> Turn:
        """Marks what has been seen; see `Goal.advance`."""
        xp = view.pose.__array_namespace__()
        cell = _cells(level.side)
        step = view.pose[..., :, None, :2] - cell[..., None, :, :]
        reach = self.sizes.hull_radius + self.sizes.sensor_range
        sees = ((step**2).sum(axis=-1) <= reach**2) & view.present[..., None]
        news = sees & state.left[..., None, :]
        left = state.left & ~sees.any(axis=-2)
        share = 1.0 - left.sum(axis=-1) / xp.maximum(state.size, 1)
        return Turn(
            state=state._replace(left=left),
            target=_nearest(left, cell, view.pose[..., :2], level),
            arrived=view.present & (share >= ENOUGH)[..., None],
            earns=news.any(axis=-1),
            measured={"floor_seen": share},
        )


def _cells(side: Array) -> Array:
    """Returns the centres [..., C, 2] of the cells of arenas with these sides [...], m."""
    middle = ((np.arange(CELLS) + 0.5) / CELLS - 0.5).astype(np.float32)
    grid = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    return side[..., None, None] * grid


def _clearance(cell: Array, level: Level) -> Array:
    """Returns the distance [..., C] from each cell's centre to the nearest box or wall, m."""
    xp, box = cell.__array_namespace__(), level.obstacle[..., None, :, :]
    away = cell[..., :, None, :] - box[..., :2]
    cos, sin = xp.cos(box[..., 2]), xp.sin(box[..., 2])
    along = xp.abs(cos * away[..., 0] + sin * away[..., 1]) - box[..., 3]
    across = xp.abs(cos * away[..., 1] - sin * away[..., 0]) - box[..., 4]
    boxes = xp.hypot(xp.maximum(along, 0.0), xp.maximum(across, 0.0))
    wall = level.side[..., None] / 2.0 - xp.abs(cell).max(axis=-1)
    return xp.minimum(boxes.min(axis=-1, initial=xp.inf), wall)


def _nearest(left: Array, cell: Array, place: Array, level: Level) -> Array:
    """Returns the nearest unseen cell [..., R, 2] of each robot; its own place if there is none."""
    xp = place.__array_namespace__()
    step = place[..., :, None, :] - cell[..., None, :, :]
    far = xp.where(left[..., None, :], (step**2).sum(axis=-1), xp.inf)
    index = far.argmin(axis=-1)[..., None]
    nearest = xp.take_along_axis(
        xp.broadcast_to(cell, (*place.shape[:-2], *cell.shape[-2:])), index, axis=-2
    )
    there = level.present[..., None] & left.any(axis=-1)[..., None, None]
    return xp.where(there, nearest, place)
