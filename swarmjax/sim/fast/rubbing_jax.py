"""Contacts of planar robots that rub, by JAX: what `planar_jax` does, with friction.

A contact has two forces, which hold the cone |rub| <= friction * push: MuJoCo's elliptic cone of
condim 3, whose third force is vertical, where no joint gives way, and stays 0. Through the centre
acts the push, and with an arm the rub, so that neither moves the robot as the other does, and

    minimise over the cone:  1/2 f' (J M^-1 J' + R) f + f' (J a0 - aref)

is, for one contact, two parabolas. Its least point is worked out at once (`project`), and
projected Gauss-Seidel goes through contacts instead of forces: one after the other, each the best
that it can do while the others push and rub as they do.
"""

import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.fast import planar_jax
from swarmjax.sim.fast.discs import TOLERANCE, DiscRobots, Discs, Rubbing, spring
from swarmjax.sim.fast.planar_jax import Contact, DiscGap


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
    touch = _touches(discs, robots, sim_model.fixture_rectangles(side, obstacle, jnp))
    free, before = (PlaneMotion(*move.T) for move in (robots.free, robots.before))
    force = _first_force(touch, _against(discs, before, len(touch.rub.arm)), _friction(robots))

    def sweep(
        carry: tuple[Array, Force, PlaneMotion, Array],
    ) -> tuple[Array, Force, PlaneMotion, Array]:
        done, force, motion, _ = carry
        changed, motion = _sweep(discs, touch, robots, motion, force)
        change = jnp.max(jnp.stack([jnp.abs(a - b) for a, b in zip(changed, force, strict=True)]))
        return done + 1, changed, motion, change > TOLERANCE * jnp.max(changed.push)

    def goes_on(carry: tuple[Array, Force, PlaneMotion, Array]) -> Array:
        done, _, _, moves = carry
        return moves & (done < discs.sweeps)

    touching = jnp.any(touch.push.gap.distance < 0.0)
    first = (jnp.int32(0), force, _moved(touch, robots, free, force), touching)
    force = jax.lax.while_loop(goes_on, sweep, first)[1]
    # Once more from the forces, without the sweeps' rounding.
    return jnp.stack(_moved(touch, robots, free, force), axis=-1)


def _rubbing(robots: DiscRobots) -> Rubbing:
    """What is needed for friction, which the model has."""
    assert robots.rubbing is not None
    return robots.rubbing


def _friction(robots: DiscRobots) -> Array:
    return _rubbing(robots).friction


def _touches(discs: Discs, robots: DiscRobots, fixture: Array) -> Touch:
    """All contacts [K, R], in the order of `planar_jax.contacts`."""
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
        more = Force(best.push - now.push, best.rub - now.rub)
        kick = _kick(one, robots, more)
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
