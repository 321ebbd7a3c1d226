"""Contacts of planar robots that rub, by JAX: what `planar_jax` does, with friction.

A contact has two forces, which hold the cone |rub| <= friction * push: MuJoCo's elliptic cone of
condim 3, whose third force is vertical, where no joint gives way, and stays 0. Through the centre
acts the push, and with an arm the rub, so that neither moves the robot as the other does, and

    minimise over the cone:  1/2 f' (J M^-1 J' + R) f + f' (J a0 - aref)

is, for one contact, two parabolas. Its least point is worked out at once (`project`), and
projected Gauss-Seidel goes through contacts instead of forces: one after the other, each the best
that it can do while the others push and rub as they do.

Robots that are wedged hand a force to and fro, a little less of it in each sweep, and an arena
takes up to 200 of these; all arenas of a call wait for it. So between sweeps forces leap to where
the last three sweeps are going (`_leap`): Anderson's acceleration (D. G. Anderson, Iterative
Procedures for Nonlinear Integral Equations, J. ACM 12, 1965) with two sweeps of memory. What it
saves, beside what else was tried, says docs/performance.md, "Sweeps of hulls that rub".
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

KEPT = 3  # sweeps that a leap is found by; one more saves 3 % in s6 (docs/performance.md)
# Added to a sum of squares, as a share of it, that rounding may leave at 0: ten times float32's.
ROUNDING = 1e-6
# Share of an acceleration that two roundings in float32 may leave. Without it 3 of 20,000 random
# crowds never came to rest, of hulls that are grazed at speed, and all arenas wait for these.
FLOOR = 2.4e-7


class Rub(NamedTuple):
    """What a contact asks for along its face, counter-clockwise about the robot.

    Attributes:
      arm: from the robot's centre to the contact, m; 0 where there is none.
      demand: aref, the acceleration along the face that is asked for, m/s^2.
      stiffness: what a unit of force brings about, J M^-1 J' + R, 1 / kg.
    """

    arm: Array
    demand: Array
    stiffness: Array


class Touch(NamedTuple):
    """A contact: how it pushes, and how it rubs."""

    push: Contact
    rub: Rub


class Force(NamedTuple):
    """Of a contact, N: along its normal, and along its face."""

    push: Array
    rub: Array


class Swept(NamedTuple):
    """The result of a sweep.

    Attributes:
      force: of all contacts after it.
      change: by how much it changed them.
    """

    force: Force
    change: Force


class Search(NamedTuple):
    """How far sweeps have come.

    Attributes:
      done: [] sweeps.
      force: to go on from.
      motion: what comes of it.
      last: result of the last sweep.
      before: result of the one before it.
      moves: [] whether the last sweep changed a force.
    """

    done: Array
    force: Force
    motion: "PlaneMotion"
    last: Swept
    before: Swept
    moves: Array


class PlaneMotion(NamedTuple):
    """Speeds or accelerations of robots, or of one against another (`turn`: both together)."""

    x: Array
    y: Array
    turn: Array


def push_apart(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Finds how the robots of one arena accelerate with their contacts.

    Args:
      discs: what is fixed.
      robots: as they are and would move, with their `rubbing`.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] of x and y, m/s^2, and of yaw, rad/s^2.
    """
    return solve(discs, robots, side, obstacle)[0]


def solve(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> tuple[Array, Array]:
    """Does what `push_apart` does, and tells how many sweeps that took.

    Args:
      discs: what is fixed.
      robots: as they are and would move, with their `rubbing`.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] of x and y, m/s^2, and of yaw, rad/s^2; and [] sweeps, int32.
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
    # Once more from the forces, without the sweeps' rounding.
    return jnp.stack(_moved(touch, robots, free, found.force), axis=-1), found.done


def _least_change(touch: Touch, motion: PlaneMotion) -> Array:
    """The force, N, that rounding of such accelerations may ask for: less is no change."""
    size = jnp.abs(motion.x) + jnp.abs(motion.y) + touch.rub.arm * jnp.abs(motion.turn)
    closed = touch.push.gap.distance < 0.0
    return FLOOR * jnp.max(jnp.where(closed, size / touch.push.stiffness, 0.0))


def _go_on(discs: Discs, touch: Touch, robots: DiscRobots, least: Array, now: Search) -> Search:
    """Sweeps once, and leaps if that is allowed."""
    force, motion = _sweep(discs, touch, robots, now.motion, now.force)
    swept = Swept(force, _minus(force, now.force))
    largest = jnp.max(jnp.stack([jnp.abs(each) for each in swept.change]))
    moves = largest > jnp.maximum(TOLERANCE * jnp.max(force.push), least)
    done = now.done + 1
    # Only where changes shrink, or leaps may go round in circles; nor in the second half of the
    # sweeps, since plain ones always come to rest.
    leaps = moves & (done >= KEPT) & (2 * done <= discs.sweeps)
    leaps &= _dot(swept.change, swept.change) <= _dot(now.last.change, now.last.change)
    leapt = _leap(touch, robots, swept, now, leaps)
    motion = _moved(touch, robots, motion, _minus(leapt, force))
    return Search(done, leapt, motion, swept, now.last, moves)


def _leap(touch: Touch, robots: DiscRobots, swept: Swept, now: Search, leaps: Array) -> Force:
    """The mix of the last three sweeps' forces that would change least in the next.

    It would if a sweep were a linear map, which it is as long as no contact begins or ends to
    press, stick or slip.
    """
    newer, older = _minus(swept.change, now.last.change), _minus(now.last.change, now.before.change)
    by_newer, by_older = (jnp.where(leaps, x, 0.0) for x in _weights(swept.change, newer, older))
    steps = _minus(swept.force, now.last.force), _minus(now.last.force, now.before.force)
    mixed = (f - by_newer * a - by_older * b for f, a, b in zip(swept.force, *steps, strict=True))
    stiffness = touch.push.stiffness, touch.rub.stiffness
    return _where_closed(touch, project(Force(*mixed), *stiffness, _friction(robots)))


def _weights(change: Force, newer: Force, older: Force) -> tuple[Array, Array]:
    """Weights x and y for which |change - x newer - y older| is least; 0 if none are told apart."""
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
    """What is needed for friction, which the model has."""
    assert robots.rubbing is not None
    return robots.rubbing


def _friction(robots: DiscRobots) -> Array:
    return _rubbing(robots).friction


def touches(discs: Discs, robots: DiscRobots, fixture: Array) -> Touch:
    """Lists all contacts that there might be, in the order of `planar_jax.contacts`.

    Args:
      discs: what is fixed.
      robots: as they are and would move, with their `rubbing`.
      fixture: [F, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [K, R] each robot with each fixture, then with whom it meets in each round.
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
    """How robots [R] move against what they may touch, [K, R]; fixtures stand.

    Two that turn alike slide on each other at twice the speed: turns add up.
    """
    still = jnp.zeros((contacts - len(discs.opponent), len(motion.x)))
    x, y, turn = (jnp.concatenate([still, a[discs.opponent]]) for a in motion)
    return PlaneMotion(motion.x - x, motion.y - y, motion.turn + turn)


def _slide(gap: DiscGap, arm: Array, motion: PlaneMotion) -> Array:
    """J a along the face: how fast the robot's rim slides on what it touches."""
    return gap.x * motion.y - gap.y * motion.x - arm * motion.turn


def _kick(touch: Touch, robots: DiscRobots, force: Force) -> PlaneMotion:
    """What forces of contacts bring about, each alone."""
    gap, mobility = touch.push.gap, robots.mobility
    return PlaneMotion(
        mobility * (gap.x * force.push - gap.y * force.rub),
        mobility * (gap.y * force.push + gap.x * force.rub),
        -_rubbing(robots).agility * touch.rub.arm * force.rub,
    )


def _moved(touch: Touch, robots: DiscRobots, free: PlaneMotion, force: Force) -> PlaneMotion:
    """Adds what forces [K, R] bring about."""
    kick = _kick(touch, robots, force)
    return PlaneMotion(*(a + jnp.sum(b, axis=0) for a, b in zip(free, kick, strict=True)))


def _sweep(
    discs: Discs, touch: Touch, robots: DiscRobots, motion: PlaneMotion, force: Force
) -> tuple[Force, PlaneMotion]:
    """Sets the forces [K, R] one contact after the other, those of all robots at once."""
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
        # Or XLA works what both forces come from out anew for each number that they change.
        best, motion = jax.lax.optimization_barrier((best, motion))
        found.append(best)
    return Force(*map(jnp.stack, zip(*found, strict=True))), motion


def _first_force(touch: Touch, motion: PlaneMotion, friction: Array) -> Force:
    """The forces that contacts would have if robots moved like this against the other."""
    push, rub = _short(touch, motion)
    give = touch.push.give
    force = project(Force(push / give, rub / give), give, give, friction)
    return _where_closed(touch, force)


def _best_force(touch: Touch, motion: PlaneMotion, force: Force, friction: Array) -> Force:
    """The forces that suit a contact best if the others push and rub as they do."""
    push, rub = _short(touch, motion)
    give, stiffness = touch.push.give, (touch.push.stiffness, touch.rub.stiffness)
    push = force.push + (push - give * force.push) / stiffness[0]
    rub = force.rub + (rub - give * force.rub) / stiffness[1]
    return _where_closed(touch, project(Force(push, rub), *stiffness, friction))


def _short(touch: Touch, motion: PlaneMotion) -> tuple[Array, Array]:
    """By how much accelerations fall short of what contacts ask for, m/s^2."""
    gap = touch.push.gap
    push = touch.push.demand - planar_jax.along(gap, planar_jax.Motion(motion.x, motion.y))
    return push, touch.rub.demand - _slide(gap, touch.rub.arm, motion)


def _where_closed(touch: Touch, force: Force) -> Force:
    """Keeps the forces of contacts that there are."""
    closed = touch.push.gap.distance < 0.0
    return Force(*(jnp.where(closed, each, 0.0) for each in force))


def project(force: Force, push: Array, rub: Array, friction: Array) -> Force:
    """The point of the cone |rub| <= friction * push that is nearest to these forces.

    Args:
      force: without the cone.
      push: what a deviation of the push costs, squared; above 0.
      rub: likewise of the rub.
      friction: [] 0 or above.

    Returns:
      The forces themselves, if they are in the cone; else the nearest point of its edge on their
      side, which is where the parabola along (1, friction) is least, or its tip.
    """
    size = jnp.abs(force.rub)
    edge = push * force.push + friction * rub * size
    edge = jnp.maximum(edge / (push + friction * friction * rub), 0.0)
    sticks = size <= friction * force.push
    slipping = jnp.sign(force.rub) * friction * edge
    return Force(jnp.where(sticks, force.push, edge), jnp.where(sticks, force.rub, slipping))
