"""Implements Bug2 (Lumelsky & Stepanov 1987) with only a robot's ten observations and commands.

"Path-planning strategies for a point mobile automaton moving amidst unknown obstacles of arbitrary
shape", Algorithmica 2, section 4. A robot drives along the line from the start to the target. When
the robot meets an obstacle, it follows the obstacle's outline and keeps the obstacle on one side.
When the robot is back on the line, and closer to the target than where it left the line, it
continues along the line.

In the paper the automaton measures its position. Here a robot integrates its own commands to get
its heading. This heading, with the observed distance and bearing of the target, gives the robot's
position.

The line is infinite and does not end at the start or at the target. A robot may therefore leave an
outline on the far side of the target, if it is closer to the target there than where it left the
line.

The paper's obstacles stand still, but robots are obstacles that move. Three rules are therefore
added:

1. A robot that meets an obstacle turns right, so that the obstacle is on its left. Two robots that
   meet head on thus pass each other. A robot follows the outline of a standing robot like any other
   outline.
2. If a robot drives `LOST` metres without sensing the outline, the outline belonged to another
   robot that has moved away, and the robot starts a new line. If a robot goes all the way round an
   outline without crossing the line at a point closer to the target, this outline was not the one
   that blocked the robot. The robot then starts a new line, and follows the next outline on the
   other side.
3. If a robot makes no progress for `STUCK` seconds, in front of another robot or between two
   robots, it also starts a new line and follows the next outline on the other side. This rule ends
   most deadlocks, but not all.

A contact can turn a robot without a command. The line is then off by the angle of this turn, until
the robot starts a new line.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmjax import epuck
from swarmjax.evaluate.engine_c import Arenas
from swarmjax.evaluate.judge import Judge
from swarmjax.sim import drive as sim_drive
from swarmjax.sim.drive import Drive
from swarmjax.task import observation

# Columns of the rays in an observation, for a wall on the left and for a wall on the right. The
# first four are the rays on the wall's side: near the nose, diagonal, beside, behind. The last
# three are the rays on the other side: near the nose, diagonal, beside.
_LEFT, _RIGHT = (7, 6, 5, 4, 0, 1, 2), (0, 1, 2, 3, 7, 6, 5)
_TARGET = tuple(observation.NAMES.index(name) for name in ("target_distance", "target_bearing"))


class Senses(NamedTuple):
    """A robot's observation; each field has shape [...], and ray lengths are in m.

    Attributes:
      nose, diagonal, beside, behind: rays on the side of the wall, from front to back.
      other_nose, other_diagonal, other_beside: rays on the other side.
      distance: distance to the target, m.
      bearing: bearing of the target, rad; left is positive.
    """

    nose: np.ndarray
    diagonal: np.ndarray
    beside: np.ndarray
    behind: np.ndarray
    other_nose: np.ndarray
    other_diagonal: np.ndarray
    other_beside: np.ndarray
    distance: np.ndarray
    bearing: np.ndarray


class BugMemory(NamedTuple):
    """A robot's memory; each field has shape [...] unless another shape is given.

    Attributes:
      heading: angle between the robot's heading and the direction of the line, rad.
      following: whether the robot follows an outline.
      side: 1.0 if the outline is on the left, -1.0 if it is on the right.
      hit: distance to the target where the robot left the line, m.
      beyond: the robot's offset from the line one control step ago, m; left is positive.
      gap: distance to the outline beside the robot one control step ago, m.
      lost: distance driven since the outline was last sensed, m.
      way: distance driven since the robot left the line, m.
      mark: [..., 3] an earlier pose on the outline (m, m, rad); the robot has gone round the
        outline when it is back at this pose.
      marked: value of `way` when the mark was set, m.
      anchor: [..., 2] position near which the robot has recently been, m.
      waited: how long the robot has been near the anchor, s.
    """

    heading: np.ndarray
    following: np.ndarray
    side: np.ndarray
    hit: np.ndarray
    beyond: np.ndarray
    gap: np.ndarray
    lost: np.ndarray
    way: np.ndarray
    mark: np.ndarray
    marked: np.ndarray
    anchor: np.ndarray
    waited: np.ndarray


class BugBody(NamedTuple):
    """The properties of a robot that the controller uses.

    Attributes:
      drive: the robot's drive.
      hull_radius: radius of the hull, m.
      target_radius: distance to the target that counts as arrival, m.
      sensor_range: range of the rays, m.
      control_step: time per control step, s.
    """

    drive: Drive
    hull_radius: float
    target_radius: float
    sensor_range: float
    control_step: float


# Lengths are in m. These values were chosen on the maps of benchmarks/maps, on stage fence2, and on
# levels of s6 and crowd_dense with seed 7.
GAP = 0.012  # desired gap between hull and outline
AHEAD = 0.025  # a shorter ray near the nose means a blocked way: a wall 0.017 m before the hull
ASIDE = 0.0167  # the hull would hit the end of this diagonal ray: 0.025 + 0.717 * 0.0167 = 0.037
# A robot on an outline returns to the line only where it is closer to the target by more than this
# than where it left the line.
NEARER = 0.03
ROUND = 0.03  # a robot is back at the mark within this distance and 90 degrees of heading
LOST = 0.33  # longer than a full circle in search of the outline: 2 pi (0.037 + 0.012) = 0.31
STILL, STUCK = 0.02, 3.0  # m, s; a robot that stays this close for this long makes no progress
SPEED, CORNER_SPEED = 0.11, 0.08  # m/s, along an outline and round its corners
TURN = 2.5  # rad/s, on the spot
BY_ANGLE, BY_GAP = 4.0, 60.0  # gains of the turn rate, rad/s per rad and rad/s per m


def start(seen: np.ndarray) -> BugMemory:
    """Starts a line from each robot's position to its target.

    Args:
      seen: [..., O] observations.

    Returns:
      The memory.
    """
    distance, bearing = (seen[..., i].astype(float) for i in _TARGET)
    zero = np.zeros_like(distance)
    here = np.stack([-distance, zero], axis=-1)
    return BugMemory(
        heading=-bearing,
        following=zero.astype(bool),
        side=zero + 1.0,
        hit=distance,
        beyond=zero,
        gap=zero + GAP,
        lost=zero,
        way=zero,
        mark=np.concatenate([here, zero[..., None]], axis=-1),
        marked=zero,
        anchor=here,
        waited=zero,
    )


def sense(seen: np.ndarray, side: np.ndarray) -> Senses:
    """Splits observations into named parts, as seen from the side of the outline.

    Args:
      seen: [..., O] observations, metric.
      side: [...] 1.0 if the outline is on the left, -1.0 if it is on the right.

    Returns:
      The senses; the bearing stays as observed.
    """
    seen = seen.astype(float)
    left, right = seen[..., _LEFT], seen[..., _RIGHT]
    rays = np.where(side[..., None] > 0.0, left, right)
    return Senses(*np.moveaxis(rays, -1, 0), *np.moveaxis(seen[..., _TARGET], -1, 0))


def locate(heading: np.ndarray, senses: Senses) -> np.ndarray:
    """Returns positions [..., 2] from the target, m: along the line, and to the line's left."""
    toward = heading + senses.bearing
    return -senses.distance[..., None] * np.stack([np.cos(toward), np.sin(toward)], axis=-1)


def act(memory: BugMemory, seen: np.ndarray, body: BugBody) -> tuple[BugMemory, np.ndarray]:
    """Takes one control step.

    Args:
      memory: [...] memory of the robots.
      seen: [..., O] the robots' observations, metric.
      body: the robots' properties.

    Returns:
      The new memory, and actions [..., 2] in -1..1.
    """
    memory = _begin_anew(memory, sense(seen, memory.side), body)
    senses = sense(seen, memory.side)
    memory = _choose(memory, senses, locate(memory.heading, senses))
    gap = senses.beside - (body.hull_radius + epuck.SENSOR_POSES[2][1])
    along = _follow(memory, senses, gap, body)
    twist = np.where(memory.following[..., None], along, _head_for_target(senses, body))
    there = senses.distance <= body.target_radius
    twist = np.where(there[..., None], 0.0, twist)
    return _remember(memory, senses, gap, twist, body), _action(twist, body.drive)


def _begin_anew(memory: BugMemory, senses: Senses, body: BugBody) -> BugMemory:
    """Starts a new line where following the outline does not help: the module's rules 2 and 3."""
    place = locate(memory.heading, senses)
    near = np.linalg.norm(place - memory.mark[..., :2], axis=-1) < ROUND
    back = near & (np.cos(memory.heading - memory.mark[..., 2]) > 0.0)
    is_round = memory.following & back & (memory.way - memory.marked > LOST)
    is_lost = memory.following & (memory.lost > LOST)
    stuck = memory.waited > STUCK
    anew = is_round | is_lost | stuck
    here = np.stack([-senses.distance, np.zeros_like(senses.distance)], axis=-1)
    return memory._replace(
        heading=np.where(anew, -senses.bearing, memory.heading),
        following=memory.following & ~anew,
        side=np.where(is_round | stuck, -memory.side, np.where(is_lost, 1.0, memory.side)),
        beyond=np.where(anew, 0.0, memory.beyond),
        anchor=np.where(anew[..., None], here, memory.anchor),
        waited=np.where(anew, 0.0, memory.waited),
    )


def _choose(memory: BugMemory, senses: Senses, place: np.ndarray) -> BugMemory:
    """Decides which robots begin to follow an outline, and which return to the line."""
    ahead = np.minimum(senses.nose, senses.other_nose) < AHEAD
    aside = np.minimum(senses.diagonal, senses.other_diagonal) < ASIDE
    hits = ~memory.following & (ahead | aside) & (np.abs(senses.bearing) < math.pi / 4)
    beside = place[..., 1]
    meets = beside * memory.beyond <= 0.0
    leaves = memory.following & meets & (senses.distance < memory.hit - NEARER)
    way = np.where(hits, 0.0, memory.way)
    # The mark moves to the robot's pose whenever the distance driven has doubled (Brent 1980). The
    # robot thus also detects a full round of an outline that is not the first one that it met.
    marks = hits | (way > 2.0 * np.maximum(memory.marked, LOST))
    pose = np.concatenate([place, memory.heading[..., None]], axis=-1)
    return memory._replace(
        following=(memory.following | hits) & ~leaves,
        side=np.where(leaves, 1.0, memory.side),
        hit=np.where(hits, senses.distance, memory.hit),
        beyond=beside,
        lost=np.where(hits, 0.0, memory.lost),
        way=way,
        mark=np.where(marks[..., None], pose, memory.mark),
        marked=np.where(marks, way, memory.marked),
    )


def _head_for_target(senses: Senses, body: BugBody) -> np.ndarray:
    """Computes twists [..., 2] straight to the target, as the baseline `straight` does."""
    off = np.abs(senses.bearing)
    speed = body.drive.max_speed * np.clip(1.0 - off, 0.0, 1.0)
    limit = body.drive.max_turn_rate
    return np.stack([speed, np.clip(2.0 * limit * senses.bearing, -limit, limit)], axis=-1)


def _follow(memory: BugMemory, senses: Senses, gap: np.ndarray, body: BugBody) -> np.ndarray:
    """Computes twists [..., 2] along the outline: m/s and rad/s; a turn to the left is positive."""
    near = 0.99 * body.sensor_range
    other = senses.other_beside - (senses.beside - gap)
    wanted = np.minimum(GAP, 0.5 * (gap + other))
    turn = BY_ANGLE * _angle(memory, senses, gap, body) + BY_GAP * (gap - wanted)
    # If only the diagonal ray senses the outline, its length is compared with the length that it
    # would have beside a wall at the desired gap.
    _, y, yaw = epuck.SENSOR_POSES[6]
    expected = (body.hull_radius + GAP - y) / math.sin(yaw)
    turn = np.where(senses.beside < near, turn, BY_GAP * (senses.diagonal - expected))
    speed = np.full_like(turn, SPEED)
    unseen = np.minimum(senses.beside, senses.diagonal) >= near
    turn = np.where(unseen, CORNER_SPEED / (body.hull_radius + GAP), np.clip(turn, -TURN, TURN))
    speed = np.where(unseen, CORNER_SPEED, speed)
    nose = np.minimum(senses.nose, senses.other_nose)
    turn, speed = (np.where(unseen & (nose < near), x, y) for x, y in ((-1.5, turn), (0.04, speed)))
    aside = np.minimum(senses.diagonal, senses.other_diagonal)
    barred = (nose < AHEAD) | (aside < ASIDE)
    turn, speed = np.where(barred, -TURN, turn), np.where(barred, 0.0, speed)
    most = body.drive.max_wheel_speed * body.drive.wheel_radius - 0.5 * body.drive.track * np.abs(
        turn
    )
    return np.stack([np.minimum(speed, most), memory.side * turn], axis=-1)


def _angle(memory: BugMemory, senses: Senses, gap: np.ndarray, body: BugBody) -> np.ndarray:
    """Estimates the angle between heading and outline, rad; positive if the outline leads away.

    If the diagonal ray senses something, its end and the end of the ray beside the robot give the
    angle. Otherwise the growth of the gap gives the angle.
    """
    x, y, yaw = epuck.SENSOR_POSES[6]
    ahead = x + senses.diagonal * math.cos(yaw)
    rise = y + senses.diagonal * math.sin(yaw) - (gap + body.hull_radius)
    both = senses.diagonal < 0.99 * body.sensor_range
    grows = (gap - memory.gap) / (SPEED * body.control_step)
    return np.where(both, np.arctan2(rise, ahead), np.arcsin(np.clip(grows, -0.7, 0.7)))


def _remember(
    memory: BugMemory, senses: Senses, gap: np.ndarray, twist: np.ndarray, body: BugBody
) -> BugMemory:
    """Updates the memory with the motion of the wheels over this control step."""
    drive, step = body.drive, body.control_step
    wheels = sim_drive.wheel_speeds(twist, drive, np)
    moved = sim_drive.body_velocity(wheels, drive.wheel_radius, drive.track, np) * step
    near = 0.99 * body.sensor_range
    rays = (senses.nose, senses.diagonal, senses.beside, senses.behind)
    sensed = np.minimum.reduce(rays) < near
    place = locate(memory.heading, senses)
    away = np.linalg.norm(place - memory.anchor, axis=-1) > STILL
    rests = away | (senses.distance <= body.target_radius)
    return memory._replace(
        heading=memory.heading + moved[..., 1],
        gap=gap,
        lost=np.where(sensed, 0.0, memory.lost + moved[..., 0]),
        way=memory.way + moved[..., 0],
        anchor=np.where(away[..., None], place, memory.anchor),
        waited=np.where(rests, 0.0, memory.waited + step),
    )


def _action(twist: np.ndarray, drive: Drive) -> np.ndarray:
    """Converts twists [..., 2] to actions [..., 2] in -1..1."""
    speed = 2.0 * twist[..., 0] / drive.max_speed - 1.0
    return np.stack([speed, twist[..., 1] / drive.max_turn_rate], axis=-1)


@dataclass(frozen=True)
class Bug2:
    """A controller for `engine_c.simulate` that drives robots by Bug2."""

    body: BugBody

    def init(self, arenas: Arenas) -> BugMemory:
        """Returns the memory [A, R] of robots at their start."""
        return start(arenas.observation)

    def act(self, memory: BugMemory, arenas: Arenas) -> tuple[BugMemory, np.ndarray]:
        """Takes one control step; reads only the observations of the arenas."""
        return act(memory, arenas.observation, self.body)


def load(judge: Judge) -> Bug2:
    """Makes the controller for the robots of a judge, with the properties of their body."""
    task, robot = judge.config.task, judge.config.robot
    body = BugBody(
        drive=judge.drive,
        hull_radius=robot.hull_radius,
        target_radius=task.target_radius,
        sensor_range=task.sensor_range,
        control_step=task.control_step,
    )
    return Bug2(body)
