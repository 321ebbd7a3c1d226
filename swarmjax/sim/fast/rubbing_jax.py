"""Solves contacts of planar robots with friction, in JAX; `planar_jax` those without friction.

A contact has two forces: a push along the normal and a rub along the face, within the cone |rub| <=
friction * push. This is MuJoCo's elliptic cone with condim 3. The third force of condim 3 is
vertical; no joint moves in this direction, so it stays 0. The push acts through the robot's centre,
and the rub acts with a lever arm. Neither force changes the acceleration along the other, so for
one contact the problem

    minimise over the cone:  1/2 f' (J M^-1 J' + R) f + f' (J a0 - aref)

is a sum of two parabolas, one for each force. The minimum of this sum in the cone has a closed form
(`project`). Projected Gauss-Seidel therefore updates contacts one by one, not forces: an update
sets both forces of a contact to their optimum, while the forces of all other contacts stay the
same.

Wedged robots pass a force back and forth, and the force changes only a little in each sweep. An
arena may take up to 200 sweeps, and all arenas that are stepped together wait for the slowest one.
To converge sooner, forces are extrapolated between sweeps, from the last three sweeps (a "leap",
see `_leap`). This is Anderson acceleration (D. G. Anderson, Iterative Procedures for Nonlinear
Integral Equations, J. ACM 12, 1965) with a memory of two sweeps. docs/performance.md compares this
method with alternatives.
"""

import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.fast import planar_jax
from swarmjax.sim.fast.discs import TOLERANCE, DiscRobots, Discs, spring
from swarmjax.sim.fast.planar_jax import DiscGap, Motion, against, against_row, of_others

KEPT = 3  # sweeps that a leap uses; a fourth would save only 3 % in stage s6
# Relative increase of a sum of squares that is used as a divisor. Without it, rounding could make
# the divisor 0. The increase is ten times float32's rounding.
ROUNDING = 1e-6
# Relative error of an acceleration after two roundings in float32. Smaller changes of an
# acceleration are ignored. Without this limit, sweeps never converged in 3 of 20,000 random crowds,
# where hulls grazed each other at high speed, and all arenas wait for such a crowd.
FLOOR = 2.4e-7


class Force(NamedTuple):
    """Two numbers of a contact, along its normal and along its face: forces (N), or parameters.

    The direction along the face is counter-clockwise around the robot.
    """

    push: Array
    rub: Array


class Touch(NamedTuple):
    """A gap, and the parameters of the contact that exists if the gap is negative.

    Attributes:
      gap: gap between the robot and the object.
      arm: lever arm from the robot's centre to the contact, m; 0 if there is no contact.
      give: softness R, 1 / kg: with a unit of force, the acceleration falls short of the demand by
        this much.
      demand: aref, requested accelerations, m/s^2.
      stiffness: J M^-1 J' + R, the effect of a unit of each force including softness, 1 / kg.
    """

    gap: DiscGap
    arm: Array
    give: Array
    demand: Force
    stiffness: Force


class Swept(NamedTuple):
    """The result of a sweep: the forces of all contacts after it, and their changes in it."""

    force: Force
    change: Force


class Search(NamedTuple):
    """Progress of the sweeps.

    Attributes:
      done: [] number of sweeps so far.
      force: forces with which the next sweep starts.
      motion: accelerations under these forces.
      last: result of the last sweep.
      before: result of the sweep before the last.
      moves: [] whether the last sweep changed a force.
    """

    done: Array
    force: Force
    motion: Motion
    last: Swept
    before: Swept
    moves: Array


def push_apart(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations of one arena's robots, including contacts.

    Args:
      discs: constants.
      robots: the state of the robots, and their accelerations without contacts.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2.
    """
    touch = _touches(discs, robots, sim_model.fixture_rectangles(side, obstacle, jnp))
    free, before = Motion(*robots.free.T), Motion(*robots.before.T)
    force = _first_force(discs, touch, against(discs, before, len(touch.arm)))
    none = Swept(*[Force(*map(jnp.zeros_like, force))] * 2)
    touching = jnp.any(touch.gap.distance < 0.0)
    first = Search(jnp.int32(0), force, _moved(touch, robots, free, force), none, none, touching)

    def goes_on(now: Search) -> Array:
        return now.moves & (now.done < discs.sweeps)

    least = _least_change(touch, against(discs, free, len(touch.arm)))
    go_on = functools.partial(_go_on, discs, touch, robots, least)
    force = jax.lax.while_loop(goes_on, go_on, first).force
    # Recompute the accelerations from the forces, without the rounding of the sweeps.
    return jnp.stack(_moved(touch, robots, free, force), axis=-1)


def _least_change(touch: Touch, motion: Motion) -> Array:
    """Returns the change of a force (N) that rounding can cause; smaller changes are ignored."""
    size = jnp.abs(motion.x) + jnp.abs(motion.y) + touch.arm * jnp.abs(motion.turn)
    closed = touch.gap.distance < 0.0
    return FLOOR * jnp.max(jnp.where(closed, size / touch.stiffness.push, 0.0))


def _go_on(discs: Discs, touch: Touch, robots: DiscRobots, least: Array, now: Search) -> Search:
    """Makes one sweep, and then a leap unless it could prevent convergence."""
    force, motion = _sweep(discs, touch, robots, now.motion, now.force)
    swept = Swept(force, _minus(force, now.force))
    largest = jnp.max(jnp.stack([jnp.abs(each) for each in swept.change]))
    moves = largest > jnp.maximum(TOLERANCE * jnp.max(force.push), least)
    done = now.done + 1
    # Leap only while changes shrink; otherwise leaps could repeat in a cycle. Do not leap in the
    # second half of the allowed sweeps, since sweeps without leaps always converge.
    leaps = moves & (done >= KEPT) & (2 * done <= discs.sweeps)
    leaps &= _dot(swept.change, swept.change) <= _dot(now.last.change, now.last.change)
    leapt = _leap(discs, touch, swept, now, leaps)
    motion = _moved(touch, robots, motion, _minus(leapt, force))
    return Search(done, leapt, motion, swept, now.last, moves)


def _leap(discs: Discs, touch: Touch, swept: Swept, now: Search, leaps: Array) -> Force:
    """Returns the mix of the last three sweeps' forces that the next sweep should change least.

    This assumes that a sweep is an affine map of the forces, which holds as long as no contact
    starts or stops pushing, sticking or slipping.
    """
    newer, older = _minus(swept.change, now.last.change), _minus(now.last.change, now.before.change)
    by_newer, by_older = (jnp.where(leaps, x, 0.0) for x in _weights(swept.change, newer, older))
    steps = _minus(swept.force, now.last.force), _minus(now.last.force, now.before.force)
    mixed = (f - by_newer * a - by_older * b for f, a, b in zip(swept.force, *steps, strict=True))
    return _best(discs, touch, Force(*mixed), touch.stiffness)


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


def _touches(discs: Discs, robots: DiscRobots, fixture: Array) -> Touch:
    """Returns all possible contacts [K, R], in the order of `planar_jax.contacts`."""
    gap, give, demand, stiffness = planar_jax.contacts(discs, robots, fixture)
    # MuJoCo puts a contact midway between the two surfaces.
    arm = jnp.where(gap.distance < 0.0, discs.radius + 0.5 * gap.distance, 0.0)
    turns = robots.agility + of_others(discs, robots.agility, len(arm))
    rate = against(discs, Motion(*robots.rate.T), len(arm))
    along = -spring(discs)[1] * _slide(gap, arm, rate)
    stiffnesses = Force(stiffness, stiffness + arm * arm * turns)
    return Touch(gap, arm, give, Force(demand, along), stiffnesses)


def _slide(gap: DiscGap, arm: Array, motion: Motion) -> Array:
    """Returns J a along the face, the part of a motion in which rim and touched object slide."""
    return gap.x * motion.y - gap.y * motion.x - arm * motion.turn


def _kick(touch: Touch, robots: DiscRobots, force: Force) -> Motion:
    """Returns the accelerations due to each contact's forces alone."""
    return Motion(
        robots.mobility * (touch.gap.x * force.push - touch.gap.y * force.rub),
        robots.mobility * (touch.gap.y * force.push + touch.gap.x * force.rub),
        -robots.agility * touch.arm * force.rub,
    )


def _moved(touch: Touch, robots: DiscRobots, free: Motion, force: Force) -> Motion:
    """Returns the accelerations `free` plus those due to the forces [K, R]."""
    kick = _kick(touch, robots, force)
    return Motion(*(a + jnp.sum(b, axis=0) for a, b in zip(free, kick, strict=True)))


def _sweep(
    discs: Discs, touch: Touch, robots: DiscRobots, motion: Motion, force: Force
) -> tuple[Force, Motion]:
    """Sets the forces [K, R] to their optimal values row by row, all robots of a row at once."""
    forces: list[Force] = []
    for k in range(len(force.push)):
        one, now = jax.tree.map(operator.itemgetter(k), (touch, force))
        best = _best_force(discs, one, against_row(discs, motion, k, len(force.push)), now)
        kick = _kick(one, robots, _minus(best, now))
        motion = Motion(*(a + b for a, b in zip(motion, kick, strict=True)))
        # Without the barrier, XLA recomputes the inputs of both forces for every result.
        best, motion = jax.lax.optimization_barrier((best, motion))
        forces.append(best)
    return Force(*map(jnp.stack, zip(*forces, strict=True))), motion


def _first_force(discs: Discs, touch: Touch, motion: Motion) -> Force:
    """Returns the forces that contacts have at this relative acceleration."""
    force = Force(*(short / touch.give for short in _short(touch, motion)))
    return _best(discs, touch, force, Force(touch.give, touch.give))


def _best_force(discs: Discs, touch: Touch, motion: Motion, force: Force) -> Force:
    """Returns the optimal forces of contacts while the forces of all others stay the same."""
    each = zip(force, _short(touch, motion), touch.stiffness, strict=True)
    wanted = Force(*(now + (short - touch.give * now) / k for now, short, k in each))
    return _best(discs, touch, wanted, touch.stiffness)


def _short(touch: Touch, motion: Motion) -> Force:
    """Returns by how much accelerations fall short of the contacts' demands, m/s^2."""
    push = touch.demand.push - planar_jax.along(touch.gap, motion)
    return Force(push, touch.demand.rub - _slide(touch.gap, touch.arm, motion))


def _best(discs: Discs, touch: Touch, wanted: Force, weight: Force) -> Force:
    """Returns `wanted` projected onto the friction cone; 0 where gaps are open."""
    closed, force = touch.gap.distance < 0.0, project(wanted, *weight, discs.friction)
    return Force(*(jnp.where(closed, each, 0.0) for each in force))


def project(force: Force, push: Array, rub: Array, friction: Any) -> Force:
    """Projects forces onto the cone |rub| <= friction * push, by weighted distance.

    Args:
      force: forces that may lie outside the cone.
      push: weight of the squared deviation of the push; above 0.
      rub: weight of the squared deviation of the rub; above 0.
      friction: friction coefficient, 0 or above.

    Returns:
      The point of the cone with the least weighted sum of squared deviations. If the forces lie in
      the cone, these are the forces themselves. Otherwise it is a point on the edge of the cone on
      the same side, or the cone's tip. Along the edge, in the direction (1, friction), the sum is a
      parabola, which has its minimum at this point.
    """
    size = jnp.abs(force.rub)
    edge = push * force.push + friction * rub * size
    edge = jnp.maximum(edge / (push + friction * friction * rub), 0.0)
    sticks = size <= friction * force.push
    slipping = jnp.sign(force.rub) * friction * edge
    return Force(jnp.where(sticks, force.push, edge), jnp.where(sticks, force.rub, slipping))
