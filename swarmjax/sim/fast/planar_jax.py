"""Solves the contacts of planar robots in JAX, for all robots of an arena at once.

`discs` describes the problem and the order of a sweep. Arrays [K, R] hold the contacts: each
fixture (obstacle or wall) has one row, with one entry per robot. Each round of `discs._rounds`, in
which each robot forms a pair with one other robot, also has one row.
"""

import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.fast.discs import DEEPEST, TOLERANCE, DiscRobots, Discs, spring
from swarmjax.sim.infrared import Box, to_box_frame, turned


class DiscGap(NamedTuple):
    """Gap between a robot and an object that it may touch.

    Attributes:
      x: x of the unit vector along which the robot is pushed.
      y: y of the same unit vector.
      distance: distance between the surfaces, m; negative if they touch.
    """

    x: Array
    y: Array
    distance: Array


class Contact(NamedTuple):
    """A gap, and the parameters of the contact that exists if the gap is negative.

    Attributes:
      gap: gap between the robot and the object.
      give: softness R, 1 / kg: with a unit of force, the acceleration falls short of the demand by
        this much.
      demand: aref, requested acceleration along the gap, m/s^2.
      stiffness: J M^-1 J' + R, the effect of a unit of force including softness, 1 / kg.
    """

    gap: DiscGap
    give: Array
    demand: Array
    stiffness: Array


class Motion(NamedTuple):
    """Velocities or accelerations of robots, or of robots relative to others (see `_minus`)."""

    x: Array
    y: Array
    turn: Array


def push_apart(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations of one arena's robots, including contacts.

    Args:
      discs: constants.
      robots: the state of the robots, and their accelerations without contacts.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2. Contacts do not change the
      acceleration of yaw.
    """
    one = contacts(discs, robots, sim_model.fixture_rectangles(side, obstacle, jnp))
    free, before = Motion(*robots.free.T), Motion(*robots.before.T)
    force = _first_force(one, against(discs, before, len(one.give)))

    def sweep(carry: tuple[Array, Array, Motion, Array]) -> tuple[Array, Array, Motion, Array]:
        done, force, motion, _ = carry
        changed, motion = _sweep(discs, one, robots.mobility, motion, force)
        change = jnp.max(jnp.abs(changed - force))
        return done + 1, changed, motion, change > TOLERANCE * jnp.max(changed)

    def goes_on(carry: tuple[Array, Array, Motion, Array]) -> Array:
        done, _, _, moves = carry
        return moves & (done < discs.sweeps)

    touching = jnp.any(one.gap.distance < 0.0)
    first = (jnp.int32(0), force, _pushed(one.gap, robots.mobility, free, force), touching)
    force = jax.lax.while_loop(goes_on, sweep, first)[1]
    # Recompute the accelerations from the forces, without the rounding of the sweeps.
    return jnp.stack(_pushed(one.gap, robots.mobility, free, force), axis=-1)


def contacts(discs: Discs, robots: DiscRobots, fixture: Array) -> Contact:
    """Returns all possible contacts [K, R]: first with the fixtures [F, 5], then with opponents."""
    x, y, other = robots.place[:, 0], robots.place[:, 1], discs.opponent
    to_fixture = _from_box(x, y, turned(fixture[:, None], jnp), discs.radius)
    meets = other - np.arange(len(x))
    ahead = jnp.sign(meets).astype(jnp.float32)
    to_robot = _from_disc(x - x[other], y - y[other], ahead, discs.radius)
    to_robot = to_robot._replace(distance=jnp.where(meets == 0, jnp.inf, to_robot.distance))
    gap = DiscGap(*map(jnp.concatenate, zip(to_fixture, to_robot, strict=True)))
    rate = against(discs, Motion(*robots.rate.T), len(gap.x))
    weight, mobility = (
        a + of_others(discs, a, len(gap.x)) for a in (robots.weight, robots.mobility)
    )
    (stiffness, damping), impedance = spring(discs), _impedance(discs, gap.distance)
    give = jnp.maximum(weight * (1.0 - impedance) / impedance, mujoco.mjMINVAL)
    demand = -damping * along(gap, rate) - stiffness * impedance * gap.distance
    return Contact(gap, give, demand, mobility + give)


def of_others(discs: Discs, of_robots: Array, contacts: int) -> Array:
    """Returns the values [K, R] of the robots that each robot may touch; 0 for fixtures."""
    still = jnp.zeros((contacts - len(discs.opponent), len(of_robots)))
    return jnp.concatenate([still, of_robots[discs.opponent]])


def against(discs: Discs, motion: Motion, contacts: int) -> Motion:
    """Returns the motion [K, R] of robots [R] relative to their opponents; fixtures stand still."""
    return _minus(motion, Motion(*(of_others(discs, a, contacts) for a in motion)))


def against_row(discs: Discs, motion: Motion, row: int, contacts: int) -> Motion:
    """Returns the row with index `row` of `against`."""
    meeting = row + len(discs.opponent) - contacts
    if meeting < 0:
        return motion
    return _minus(motion, Motion(*(a[discs.opponent[meeting]] for a in motion)))


def _minus(motion: Motion, other: Motion) -> Motion:
    """Returns the motion of robots relative to that of other robots.

    If two robots turn the same way, their surfaces slide on each other at the sum of both speeds,
    so the turn rates are added.
    """
    return Motion(motion.x - other.x, motion.y - other.y, motion.turn + other.turn)


def _pushed(gap: DiscGap, mobility: Array, free: Motion, force: Array) -> Motion:
    """Returns the accelerations `free` plus those due to the forces [K, R]."""
    x, y = (jnp.sum(way * force, axis=0) for way in (gap.x, gap.y))
    return Motion(free.x + mobility * x, free.y + mobility * y, free.turn)


def _sweep(
    discs: Discs, contacts: Contact, mobility: Array, motion: Motion, force: Array
) -> tuple[Array, Motion]:
    """Sets the forces [K, R] to their optimal values row by row, all robots of a row at once."""
    forces = []
    for k, now in enumerate(force):
        one = jax.tree.map(operator.itemgetter(k), contacts)
        best = _best_force(one, against_row(discs, motion, k, len(force)), now)
        more = mobility * (best - now)
        x, y = motion.x + more * one.gap.x, motion.y + more * one.gap.y
        motion = Motion(x, y, motion.turn)
        forces.append(best)
    return jnp.stack(forces), motion


def _from_box(x: Array, y: Array, box: Box, radius: float) -> DiscGap:
    """Returns the gaps between boxes and robots whose centres are at x and y (m).

    The gap is measured from the box's point nearest to the hull's centre. A centre within the box
    has no such point, so its gap is measured from the nearest face, unless that face is the top or
    the bottom (`discs.DEEPEST`).
    """
    x, y = to_box_frame(x - box.x, y - box.y, box)
    over_x, over_y = jnp.abs(x) - box.half_x, jnp.abs(y) - box.half_y
    within = jnp.maximum(over_x, over_y) <= 0.0
    along_x = jnp.where(within, jnp.where(over_x > over_y, 1.0, 0.0), jnp.maximum(over_x, 0.0))
    along_y = jnp.where(within, jnp.where(over_x > over_y, 0.0, 1.0), jnp.maximum(over_y, 0.0))
    length = jnp.sqrt(along_x * along_x + along_y * along_y)
    # A centre midway between two faces is pushed out through the face on the negative side.
    along_x = jnp.where(x > 0.0, along_x, -along_x) / length
    along_y = jnp.where(y > 0.0, along_y, -along_y) / length
    depth = -jnp.maximum(over_x, over_y)
    away = jnp.where(within, jnp.where(depth > DEEPEST, jnp.inf, -depth), length)
    world_x = box.cos * along_x - box.sin * along_y
    return DiscGap(world_x, box.sin * along_x + box.cos * along_y, away - radius)


def _from_disc(x: Array, y: Array, ahead: Array, radius: float) -> DiscGap:
    """Returns the gaps between robots and others; the vector (x, y) in m points to the robots.

    Two hulls at the same place push each other along x, as in MuJoCo. In each pair, `ahead` is 1
    for one robot and -1 for the other. The robot with 1 is pushed towards negative x.
    """
    apart = jnp.sqrt(x * x + y * y)
    along_x = jnp.where(apart > 0.0, x / apart, -ahead)
    return DiscGap(along_x, jnp.where(apart > 0.0, y / apart, 0.0), apart - 2.0 * radius)


def along(gap: DiscGap, motion: Motion) -> Array:
    """Returns J a, the part of a relative motion in which a robot moves away from the object."""
    return gap.x * motion.x + gap.y * motion.y


def _first_force(one: Contact, motion: Motion) -> Array:
    """Returns the force (N) that a contact has at this relative acceleration."""
    force = jnp.maximum((one.demand - along(one.gap, motion)) / one.give, 0.0)
    return jnp.where(one.gap.distance < 0.0, force, 0.0)


def _best_force(one: Contact, motion: Motion, force: Array) -> Array:
    """Returns the optimal force (N) of a contact while all other forces stay the same."""
    short = one.demand - along(one.gap, motion) - one.give * force
    best = jnp.maximum(force + short / one.stiffness, 0.0)
    return jnp.where(one.gap.distance < 0.0, best, 0.0)


def _impedance(discs: Discs, distance: Array) -> Array:
    """Returns impedances at distances (m): d(r) in MuJoCo's documentation, "Solver parameters"."""
    least, most, width, middle, power = (float(x) for x in discs.solimp)
    share = jnp.minimum(jnp.abs(distance) / width, 1.0)
    before = share**power / middle ** (power - 1.0)
    after = 1.0 - (1.0 - share) ** power / (1.0 - middle) ** (power - 1.0)
    return least + jnp.where(share < middle, before, after) * (most - least)
