"""Contacts of planar robots with friction, in JAX; `planar_jax` is the version without friction.

A contact has two forces within the cone |rub| <= friction * push: a push along the normal and a rub
along the face. This is MuJoCo's elliptic cone of condim 3. The third force is vertical, where no
joint moves, and stays 0. The push acts through the robot's centre, and the rub acts with a lever
arm. Push and rub move the robot in different ways, so for one contact the problem

    minimise over the cone:  1/2 f' (J M^-1 J' + R) f + f' (J a0 - aref)

is two separate parabolas. The least point of their sum in the cone has a closed form (`project`).
Projected Gauss-Seidel then goes through contacts instead of forces. A step sets one contact to its
best forces while the other forces stay the same.

Wedged robots pass a force back and forth, and the force shrinks only a little in each sweep. An
arena may take up to 200 sweeps, and all arenas of a call wait for the slowest arena. So between
sweeps, forces leap to where the last three sweeps are heading (`_leap`). This is Anderson
acceleration (D. G. Anderson, Iterative Procedures for Nonlinear Integral Equations, J. ACM 12,
1965) with a memory of two sweeps. docs/performance.md compares this method with alternatives.
"""

import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.fast import planar_jax
from swarmjax.sim.fast.discs import TOLERANCE, DiscRobots, Discs, Rubbing, spring
from swarmjax.sim.fast.planar_jax import Contact, DiscGap

KEPT = 3  # sweeps that a leap uses; a fourth saves 3 % in s6 (docs/performance.md)
# Relative increase of a sum of squares. The increase is ten times float32's rounding. Without the
# increase, rounding may turn the sum into 0.
ROUNDING = 1e-6
# Relative error of an acceleration after two roundings in float32. Smaller changes of an
# acceleration are ignored. Otherwise, 3 of 20,000 random crowds never came to rest. In these
# crowds, hulls were grazed at speed. All arenas wait for such a crowd.
FLOOR = 2.4e-7


class Rub(NamedTuple):
    """Parameters of a contact along its face, counter-clockwise around the robot.

    Attributes:
      arm: lever arm from the robot's centre to the contact, m; 0 without contact.
      demand: aref, requested acceleration along the face, m/s^2.
      stiffness: J M^-1 J' + R, effect of a unit of force, 1 / kg.
    """

    arm: Array
    demand: Array
    stiffness: Array


class Touch(NamedTuple):
    """A contact: its normal part and its friction part."""

    push: Contact
    rub: Rub


class Force(NamedTuple):
    """Forces of a contact, N: along its normal, and along its face."""

    push: Array
    rub: Array


class Swept(NamedTuple):
    """The result of a sweep.

    Attributes:
      force: forces of all contacts after the sweep.
      change: change of the forces in the sweep.
    """

    force: Force
    change: Force


class Search(NamedTuple):
    """Progress of the sweeps.

    Attributes:
      done: [] sweeps.
      force: forces to continue from.
      motion: accelerations under these forces.
      last: result of the last sweep.
      before: result of the sweep before the last.
      moves: [] whether the last sweep changed a force.
    """

    done: Array
    force: Force
    motion: "PlaneMotion"
    last: Swept
    before: Swept
    moves: Array


class PlaneMotion(NamedTuple):
    """Velocities or accelerations, of robots or of pairs of robots (`turn` is then a sum)."""

    x: Array
    y: Array
    turn: Array


def push_apart(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations of one arena's robots, including contacts.

    Args:
      discs: constants.
      robots: their state, accelerations without contacts, and `rubbing`.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2.
    """
    return solve(discs, robots, side, obstacle)[0]


def solve(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> tuple[Array, Array]:
    """Does the same as `push_apart`, and also returns the number of sweeps.

    Args:
      discs: constants.
      robots: their state, accelerations without contacts, and `rubbing`.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2; and the number of sweeps [],
      int32.
    """
    touch = touches(discs, robots, sim_model.fixture_rectangles(side, obstacle, jnp))
    free, before = (PlaneMotion(*move.T) for move in (robots.free, robots.before))
    force = _first_force(touch, _against(discs, before, len(touch.rub.arm)), _friction(robots))
    none = Swept(*[Force(*map(jnp.zeros_like, force))] * 2)
    touching = jnp.any(touch.push.gap.distance < 0.0)
    motion = _moved(touch, robots, free, force)
    first = Search(jnp.int32(0), force, motion, none, none, touching)

    def goes_on(now: Search) -> Array:
        return now.moves & (now.done < discs.sweeps)

    least = _least_change(touch, _against(discs, free, len(touch.rub.arm)))
    go_on = functools.partial(_go_on, discs, touch, robots, least)
    found = jax.lax.while_loop(goes_on, go_on, first)
    # Recompute the accelerations from the forces, without the rounding of the sweeps.
    return jnp.stack(_moved(touch, robots, free, found.force), axis=-1), found.done


def _least_change(touch: Touch, motion: PlaneMotion) -> Array:
    """Returns the force, N, that rounding can cause; smaller changes are to be ignored."""
    size = jnp.abs(motion.x) + jnp.abs(motion.y) + touch.rub.arm * jnp.abs(motion.turn)
    closed = touch.push.gap.distance < 0.0
    return FLOOR * jnp.max(jnp.where(closed, size / touch.push.stiffness, 0.0))


def _go_on(discs: Discs, touch: Touch, robots: DiscRobots, least: Array, now: Search) -> Search:
    """Makes one sweep, and then a leap if that is allowed."""
    force, motion = _sweep(discs, touch, robots, now.motion, now.force)
    swept = Swept(force, _minus(force, now.force))
    largest = jnp.max(jnp.stack([jnp.abs(each) for each in swept.change]))
    moves = largest > jnp.maximum(TOLERANCE * jnp.max(force.push), least)
    done = now.done + 1
    # Leap only while changes shrink; otherwise leaps could go around in circles. Do not leap in the
    # second half of the sweeps, since plain sweeps always come to rest.
    leaps = moves & (done >= KEPT) & (2 * done <= discs.sweeps)
    leaps &= _dot(swept.change, swept.change) <= _dot(now.last.change, now.last.change)
    leapt = _leap(touch, robots, swept, now, leaps)
    motion = _moved(touch, robots, motion, _minus(leapt, force))
    return Search(done, leapt, motion, swept, now.last, moves)


def _leap(touch: Touch, robots: DiscRobots, swept: Swept, now: Search, leaps: Array) -> Force:
    """Returns the mix of the last three sweeps' forces that should change least in the next sweep.

    This assumes that a sweep is a linear map. A sweep is linear as long as no contact starts or
    stops pushing, sticking or slipping.
    """
    newer, older = _minus(swept.change, now.last.change), _minus(now.last.change, now.before.change)
    by_newer, by_older = (jnp.where(leaps, x, 0.0) for x in _weights(swept.change, newer, older))
    steps = _minus(swept.force, now.last.force), _minus(now.last.force, now.before.force)
    mixed = (f - by_newer * a - by_older * b for f, a, b in zip(swept.force, *steps, strict=True))
    stiffness = touch.push.stiffness, touch.rub.stiffness
    return _where_closed(touch, project(Force(*mixed), *stiffness, _friction(robots)))


def _weights(change: Force, newer: Force, older: Force) -> tuple[Array, Array]:
    """Returns weights x and y that minimise |change - x newer - y older|; 0 if undetermined."""
    size = _dot(older, older)
    share = _dot(newer, older) / size
    left = _dot(newer, newer) * (1.0 + ROUNDING) - share * _dot(newer, older)
    known = (size > 0.0) & (left > 0.0)
    by_newer = (_dot(change, newer) - share * _dot(change, older)) / left
    by_older = (_dot(change, older) - by_newer * _dot(newer, older)) / size
    return jnp.where(known, by_newer, 0.0), jnp.where(known, by_older, 0.0)


def _dot(one: Force, other: Force) -> Array:
    return jnp.sum(one.push * other.push) + jnp.sum(one.rub * other.rub)


def _minus(one: Force, other: Force) -> Force:
    return Force(one.push - other.push, one.rub - other.rub)


def _rubbing(robots: DiscRobots) -> Rubbing:
    """Returns the quantities for friction, which must be present."""
    assert robots.rubbing is not None
    return robots.rubbing


def _friction(robots: DiscRobots) -> Array:
    return _rubbing(robots).friction


def touches(discs: Discs, robots: DiscRobots, fixture: Array) -> Touch:
    """Lists all possible contacts, in the order of `planar_jax.contacts`.

    Args:
      discs: constants.
      robots: their state, accelerations without contacts, and `rubbing`.
      fixture: [F, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [K, R] each robot with each fixture, then with its opponent in each round.
    """
    push = planar_jax.contacts(discs, robots, fixture)
    distance, count = push.gap.distance, len(fixture)
    # MuJoCo puts a contact midway between the two surfaces.
    arm = jnp.where(distance < 0.0, discs.radius + 0.5 * distance, 0.0)
    agility = _rubbing(robots).agility
    alone = jnp.broadcast_to(agility, (count, len(agility)))
    turns = jnp.concatenate([alone, agility + agility[discs.opponent]])
    rate = _against(discs, PlaneMotion(*robots.rate.T), len(arm))
    demand = -spring(discs)[1] * _slide(push.gap, arm, rate)
    return Touch(push, Rub(arm, demand, push.stiffness + arm * arm * turns))


def _against(discs: Discs, motion: PlaneMotion, contacts: int) -> PlaneMotion:
    """Returns the motion [K, R] of robots [R] relative to their opponents; fixtures stand still.

    Two robots that turn the same way slide on each other at twice the speed, so turns are added.
    """
    still = jnp.zeros((contacts - len(discs.opponent), len(motion.x)))
    x, y, turn = (jnp.concatenate([still, a[discs.opponent]]) for a in motion)
    return PlaneMotion(motion.x - x, motion.y - y, motion.turn + turn)


def _slide(gap: DiscGap, arm: Array, motion: PlaneMotion) -> Array:
    """Returns J a along the face: how fast the robot's rim slides on the touched object."""
    return gap.x * motion.y - gap.y * motion.x - arm * motion.turn


def _kick(touch: Touch, robots: DiscRobots, force: Force) -> PlaneMotion:
    """Returns the accelerations due to each contact's forces alone."""
    gap, mobility = touch.push.gap, robots.mobility
    return PlaneMotion(
        mobility * (gap.x * force.push - gap.y * force.rub),
        mobility * (gap.y * force.push + gap.x * force.rub),
        -_rubbing(robots).agility * touch.rub.arm * force.rub,
    )


def _moved(touch: Touch, robots: DiscRobots, free: PlaneMotion, force: Force) -> PlaneMotion:
    """Adds the accelerations due to forces [K, R]."""
    kick = _kick(touch, robots, force)
    return PlaneMotion(*(a + jnp.sum(b, axis=0) for a, b in zip(free, kick, strict=True)))


def _sweep(
    discs: Discs, touch: Touch, robots: DiscRobots, motion: PlaneMotion, force: Force
) -> tuple[Force, PlaneMotion]:
    """Sets the forces [K, R] to their best values, row by row, for all robots of a row at once."""
    found: list[Force] = []
    fixtures, friction = len(force.push) - len(discs.opponent), _friction(robots)
    for k in range(len(force.push)):
        one, now = jax.tree.map(operator.itemgetter(k), (touch, force))
        apart = motion
        if k >= fixtures:
            other = discs.opponent[k - fixtures]
            x, y, turn = (a[other] for a in motion)
            apart = PlaneMotion(motion.x - x, motion.y - y, motion.turn + turn)
        best = _best_force(one, apart, now, friction)
        kick = _kick(one, robots, _minus(best, now))
        motion = PlaneMotion(*(a + b for a, b in zip(motion, kick, strict=True)))
        # Without the barrier, XLA recomputes the inputs of both forces for every result.
        best, motion = jax.lax.optimization_barrier((best, motion))
        found.append(best)
    return Force(*map(jnp.stack, zip(*found, strict=True))), motion


def _first_force(touch: Touch, motion: PlaneMotion, friction: Array) -> Force:
    """Returns the forces of contacts at this relative motion."""
    push, rub = _short(touch, motion)
    give = touch.push.give
    force = project(Force(push / give, rub / give), give, give, friction)
    return _where_closed(touch, force)


def _best_force(touch: Touch, motion: PlaneMotion, force: Force, friction: Array) -> Force:
    """Returns the best forces of a contact while all other forces stay the same."""
    push, rub = _short(touch, motion)
    give, stiffness = touch.push.give, (touch.push.stiffness, touch.rub.stiffness)
    push = force.push + (push - give * force.push) / stiffness[0]
    rub = force.rub + (rub - give * force.rub) / stiffness[1]
    return _where_closed(touch, project(Force(push, rub), *stiffness, friction))


def _short(touch: Touch, motion: PlaneMotion) -> tuple[Array, Array]:
    """Returns how far accelerations fall short of the contacts' demands, m/s^2."""
    gap = touch.push.gap
    push = touch.push.demand - planar_jax.along(gap, planar_jax.Motion(motion.x, motion.y))
    return push, touch.rub.demand - _slide(gap, touch.rub.arm, motion)


def _where_closed(touch: Touch, force: Force) -> Force:
    """Sets the forces of open gaps to 0."""
    closed = touch.push.gap.distance < 0.0
    return Force(*(jnp.where(closed, each, 0.0) for each in force))


def project(force: Force, push: Array, rub: Array, friction: Array) -> Force:
    """Returns the point of the cone |rub| <= friction * push that is nearest to these forces.

    Args:
      force: forces that may lie outside the cone.
      push: weight of the squared deviation of the push; above 0.
      rub: weight of the squared deviation of the rub; above 0.
      friction: [] 0 or above.

    Returns:
      The forces themselves, if they lie in the cone; otherwise the nearest point of the cone's edge
      on the same side, or the cone's tip. The nearest point of an edge is the least point of the
      parabola along (1, friction).
    """
    size = jnp.abs(force.rub)
    edge = push * force.push + friction * rub * size
    edge = jnp.maximum(edge / (push + friction * friction * rub), 0.0)
    sticks = size <= friction * force.push
    slipping = jnp.sign(force.rub) * friction * edge
    return Force(jnp.where(sticks, force.push, edge), jnp.where(sticks, force.rub, slipping))
