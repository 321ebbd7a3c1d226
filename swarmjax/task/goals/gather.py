"""`gather`: all robots come together, anywhere.

Each robot senses distance and bearing of the middle of all other robots, as a range-and-bearing
board or a camera gives them. No meeting place is set. Robots have gathered when all centres lie in
a disc around their middle. The disc has four times the area of all hulls together.
"""

from collections.abc import Mapping
from typing import Any

from swarmjax.task.goals.goal import Goal, Measure, Turn
from swarmjax.task.level import Level
from swarmjax.task.observation import View

Array = Any
# Robots whose hulls are closer than this belong to one cluster, in hull radii.
_LINK = 2.0


class Gather(Goal):
    """The target of a robot is the middle of the others."""

    measures: Mapping[str, Measure] = {
        "largest_cluster": Measure("in the largest cluster", "%", is_good=True)
    }

    def begin(self, level: Level) -> tuple[tuple[()], Array]:
        """Returns the first targets; see `Goal.begin`."""
        return (), _middle_of_others(level.start[..., :2], level.present)

    def advance(self, state: Any, level: Level, view: View) -> Turn:
        """Says whether the robots are together; see `Goal.advance`."""
        del level
        xp = view.pose.__array_namespace__()
        place, present = view.pose[..., :2], view.present
        count = present.sum(axis=-1)[..., None]
        middle = xp.where(present[..., None], place, 0.0).sum(axis=-2) / count
        away = xp.sqrt(((place - middle[..., None, :]) ** 2).sum(axis=-1))
        disc = 2.0 * self.sizes.hull_radius * xp.sqrt(count)
        return Turn(
            state=state,
            target=_middle_of_others(place, present),
            arrived=present & (away <= disc),
            measured={"largest_cluster": self._largest_cluster(place, present)},
        )

    def _largest_cluster(self, place: Array, present: Array) -> Array:
        """Returns the share [...] of the robots that belong to the largest cluster."""
        step = place[..., :, None, :] - place[..., None, :, :]
        near = (step**2).sum(axis=-1) <= ((2.0 + _LINK) * self.sizes.hull_radius) ** 2
        linked = near & present[..., None] & present[..., None, :]
        for _ in range((present.shape[-1] - 1).bit_length()):  # each round doubles the links
            linked = (linked[..., :, :, None] & linked[..., None, :, :]).any(axis=-2)
        return linked.sum(axis=-1).max(axis=-1) / present.sum(axis=-1)


def _middle_of_others(place: Array, present: Array) -> Array:
    """Returns for each robot the mean place [..., R, 2] of the others; its own if it is alone."""
    xp = place.__array_namespace__()
    there = present[..., None]
    others = xp.maximum(present.sum(axis=-1) - 1, 1)[..., None, None]
    whole = xp.where(there, place, 0.0).sum(axis=-2)[..., None, :]
    alone = (present.sum(axis=-1) == 1)[..., None, None]
    return xp.where(there & ~alone, (whole - place) / others, place)
