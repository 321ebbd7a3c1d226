"""A physics step of planar robots by JAX: discs that push each other, walls and boxes.

MJX's own step builds every contact in space and factorises one matrix for all robots at every
iteration of Newton's method; on a CPU that is nine tenths of it. A hull is a sphere between
upright faces, so in the plane it is a disc, and its contacts (condim 1) push through its centre:
they move it along x and y and never turn it. What they push with is MuJoCo's convex problem, in
the dual form and by the method of `solver_planar`: projected Gauss-Seidel, MuJoCo's own PGS,

    f_i <- max(0, f_i + (aref_i - J_i a - R_i f_i) / (J_i M^-1 J_i' + R_i)),

a always being the acceleration that the forces of now bring about. A sweep goes through the
fixtures one by one, for all robots at once, and through the pairs of robots in rounds in which
nobody meets twice, as a tournament is drawn.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx

from swarmjax.sim import model as sim_model
from swarmjax.sim.geom import CONTACT_HEIGHT
from swarmjax.sim.infrared import to_box_frame, turned

# Share of the largest force by which any may still change; float32 rounds at 1e-7.
TOLERANCE = 1e-6
# A centre that is deeper within a box than it is below its top or above its bottom, m, is pushed
# up or down by MuJoCo, where no joint gives way.
_DEEPEST = min(CONTACT_HEIGHT, 2.0 * sim_model.HALF_HEIGHT - CONTACT_HEIGHT)


class Discs(NamedTuple):
    """What is fixed for a program.

    Attributes:
      radius: of the hulls, m.
      timestep: one physics step, s.
      sweeps: at most.
      body: [R] rows of the hulls among the model's bodies.
      opponent: [N, R] whom a robot meets in a round; itself: nobody.
      solref: time constant (s) and damping ratio of all contacts.
      solimp: their impedance: smallest, largest, width (m), midpoint, power.
    """

    radius: float
    timestep: float
    sweeps: int
    body: np.ndarray
    opponent: np.ndarray
    solref: np.ndarray
    solimp: np.ndarray


class Contacts(NamedTuple):
    """Contacts of robots [R], those with each fixture and then those of each round: [K, R].

    Attributes:
      x: of the unit vector along which the robot is pushed.
      y: likewise.
      distance: between the surfaces, m; below 0 they touch.
      give: R, what a unit of force leaves of the demand, 1 / kg.
      demand: aref, the acceleration along the vector that is asked for, m/s^2.
      stiffness: what a unit of force brings about, J M^-1 J' + R, 1 / kg.
    """

    x: Array
    y: Array
    distance: Array
    give: Array
    demand: Array
    stiffness: Array


class Motion(NamedTuple):
    """Of the robots [R]: their accelerations along x and y, m/s^2, and 1 / mass, 1 / kg."""

    x: Array
    y: Array
    mobility: Array


def load(model: mujoco.MjModel, ids: sim_model.Ids, radius: float) -> Discs:
    """Takes what a step needs from a model of planar robots.

    Args:
      model: compiled, one arena.
      ids: where things lie in it.
      radius: of the hulls, m.

    Returns:
      What is fixed for a program.
    """
    solref, solimp = np.unique(model.pair_solref, axis=0), np.unique(model.pair_solimp, axis=0)
    assert len(solref) == len(solimp) == 1
    assert solref.min() > 0.0  # otherwise it means stiffness and damping
    rounds = _rounds(len(ids.hull_body))
    of_model = model.opt.timestep, model.opt.iterations, ids.hull_body
    return Discs(radius, *of_model, rounds, solref[0], solimp[0])


def step(discs: Discs, model: mjx.Model, data: mjx.Data, side: Array, obstacle: Array) -> mjx.Data:
    """Moves one arena on by one physics step (MuJoCo's semi-implicit Euler).

    Args:
      discs: what is fixed.
      model: of which masses and inverse weights are read.
      data: the arena; `qfrc_applied` is all that acts on it but contacts.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      The arena; of what MJX derives from positions and velocities nothing is worked out.
    """
    mass, turn = model.body_mass[discs.body], model.body_inertia[discs.body, 2]
    force = data.qfrc_applied.reshape(-1, 3)
    free = Motion(force[:, 0] / mass, force[:, 1] / mass, 1.0 / mass)
    place, rate = data.qpos.reshape(-1, 3), data.qvel.reshape(-1, 3)
    weight = model.body_invweight0[discs.body, 0]
    fixture = sim_model.fixture_rectangles(side, obstacle, jnp)
    contacts = _contacts(discs, place, rate, fixture, weight, free.mobility)
    before = data.qacc_warmstart.reshape(-1, 3)
    moved = _push_apart(discs, contacts, free, free._replace(x=before[:, 0], y=before[:, 1]))
    acceleration = jnp.stack([moved.x, moved.y, force[:, 2] / turn], axis=-1).reshape(-1)
    velocity = data.qvel + discs.timestep * acceleration
    return data.replace(
        qpos=data.qpos + discs.timestep * velocity,
        qvel=velocity,
        qacc=acceleration,
        qacc_warmstart=acceleration,
        time=data.time + discs.timestep,
    )


def _rounds(robots: int) -> np.ndarray:
    """Draws a tournament: whom each robot meets in each round, [N, R]; itself: nobody.

    Of an odd number N of players, two meet in the round that is their sum modulo N (the circle
    method); the one that is left over rests, or meets the last of an even number.
    """
    rounds = robots - 1 + robots % 2
    player = np.arange(rounds)
    opponent = (player[:, None] - player) % rounds
    if robots % 2 == 1:
        return opponent
    left = player * (rounds + 1) // 2 % rounds
    opponent[player, left] = rounds
    return np.concatenate([opponent, left[:, None]], axis=1)


def _contacts(
    discs: Discs, place: Array, rate: Array, fixture: Array, weight: Array, mobility: Array
) -> Contacts:
    """Finds all contacts of robots at poses [R, 3] with these rates, weights and mobilities [R]."""
    other = discs.opponent
    to_fixture = _from_fixtures(place, fixture, discs.radius)
    to_robot = _from_robots(place, other, discs.radius)
    x, y, distance = (jnp.concatenate(parts) for parts in zip(to_fixture, to_robot, strict=True))
    still = jnp.zeros_like(to_fixture[0])  # what fixtures have of anything

    def relative(of_robots: Array, *, sign: float = -1.0) -> Array:
        return of_robots + sign * jnp.concatenate([still, of_robots[other]])

    speed = x * relative(rate[:, 0]) + y * relative(rate[:, 1])
    stiffness, damping, impedance = _softness(discs, distance)
    soft = relative(weight, sign=1.0) * (1.0 - impedance) / impedance
    give = jnp.maximum(soft, mujoco.mjMINVAL)
    demand = -damping * speed - stiffness * impedance * distance
    return Contacts(x, y, distance, give, demand, relative(mobility, sign=1.0) + give)


def _from_fixtures(place: Array, fixture: Array, radius: float) -> tuple[Array, Array, Array]:
    """Unit vectors from rectangles [F, 5] to robots, x and y, and the distances: [F, R] each.

    From the nearest point of the rectangle; of a centre within it, from the nearest face, unless
    that is the top or the bottom.
    """
    box = turned(fixture[:, None], jnp)
    x, y = to_box_frame(place[:, 0] - box.x, place[:, 1] - box.y, box)
    over_x, over_y = jnp.abs(x) - box.half_x, jnp.abs(y) - box.half_y
    within = jnp.maximum(over_x, over_y) <= 0.0
    along_x = jnp.where(within, over_x > over_y, jnp.maximum(over_x, 0.0))
    along_y = jnp.where(within, over_x <= over_y, jnp.maximum(over_y, 0.0))
    length = jnp.sqrt(along_x * along_x + along_y * along_y)
    # In the middle between two faces a centre is pushed out of the one at the negative end.
    along_x = jnp.where(x > 0.0, along_x, -along_x) / length
    along_y = jnp.where(y > 0.0, along_y, -along_y) / length
    depth = -jnp.maximum(over_x, over_y)
    away = jnp.where(within, jnp.where(depth > _DEEPEST, jnp.inf, -depth), length)
    world_x = box.cos * along_x - box.sin * along_y
    return world_x, box.sin * along_x + box.cos * along_y, away - radius


def _from_robots(place: Array, other: np.ndarray, radius: float) -> tuple[Array, Array, Array]:
    """Unit vectors to robots from those they meet [N, R], x and y, and distances: [N, R] each."""
    apart_x, apart_y = (place[:, i] - place[other, i] for i in range(2))
    apart = jnp.sqrt(apart_x * apart_x + apart_y * apart_y)
    # Two hulls in one place push each other along x, as MuJoCo's do.
    meets = other - np.arange(other.shape[1])
    x = jnp.where(apart > 0.0, apart_x / apart, -np.sign(meets).astype(np.float32))
    y = jnp.where(apart > 0.0, apart_y / apart, 0.0)
    return x, y, jnp.where(meets == 0, jnp.inf, apart - 2.0 * radius)


def _softness(discs: Discs, distance: Array) -> tuple[float, float, Array]:
    """Stiffness (1/s^2), damping (1/s) and impedance of contacts at distances (m).

    MuJoCo's documentation, Modeling, "Solver parameters": k, b and d(r) of `solref` and `solimp`.
    """
    least, most, width, middle, power = (float(x) for x in discs.solimp)
    constant, ratio = max(float(discs.solref[0]), 2.0 * discs.timestep), float(discs.solref[1])
    stiffness = 1.0 / (most * constant * ratio) ** 2
    share = jnp.minimum(jnp.abs(distance) / width, 1.0)
    before = share**power / middle ** (power - 1.0)
    after = 1.0 - (1.0 - share) ** power / (1.0 - middle) ** (power - 1.0)
    impedance = least + jnp.where(share < middle, before, after) * (most - least)
    return stiffness, 2.0 / (most * constant), impedance


def _push_apart(discs: Discs, contacts: Contacts, free: Motion, before: Motion) -> Motion:
    """Finds how robots move with their contacts, from how they do without and did before."""
    touching = contacts.distance < 0.0
    short = contacts.demand - _along(discs, contacts, before)
    force = jnp.where(touching, jnp.maximum(short / contacts.give, 0.0), 0.0)

    def sweep(carry: tuple[Array, Array, Motion, Array]) -> tuple[Array, Array, Motion, Array]:
        done, force, motion, _ = carry
        changed, motion = _sweep(discs, contacts, motion, force)
        change = jnp.max(jnp.abs(changed - force))
        return done + 1, changed, motion, change > TOLERANCE * jnp.max(changed)

    def goes_on(carry: tuple[Array, Array, Motion, Array]) -> Array:
        done, _, _, moves = carry
        return moves & (done < discs.sweeps)

    first = (jnp.int32(0), force, _pushed(contacts, free, force), jnp.any(touching))
    # Once more from the forces, without the sweeps' rounding.
    return _pushed(contacts, free, jax.lax.while_loop(goes_on, sweep, first)[1])


def _along(discs: Discs, contacts: Contacts, motion: Motion) -> Array:
    """J a [K, R]: how fast robots accelerate away from what they may touch."""
    fixtures = len(contacts.x) - len(discs.opponent)
    still = jnp.zeros_like(contacts.x[:fixtures])
    x, y = (a - jnp.concatenate([still, a[discs.opponent]]) for a in (motion.x, motion.y))
    return contacts.x * x + contacts.y * y


def _pushed(contacts: Contacts, free: Motion, force: Array) -> Motion:
    """Adds what forces [K, R] bring about."""
    x = free.x + free.mobility * jnp.sum(contacts.x * force, axis=0)
    return free._replace(x=x, y=free.y + free.mobility * jnp.sum(contacts.y * force, axis=0))


def _sweep(discs: Discs, contacts: Contacts, motion: Motion, force: Array) -> tuple[Array, Motion]:
    """Sets the forces [K, R] one after the other, those of all robots at once, to their best."""
    found, fixtures = [], len(contacts.x) - len(discs.opponent)
    for k in range(len(force)):
        one = Contacts(*(field[k] for field in contacts))
        x, y = motion.x, motion.y
        if k >= fixtures:
            other = discs.opponent[k - fixtures]
            x, y = x - x[other], y - y[other]
        short = one.demand - (one.x * x + one.y * y) - one.give * force[k]
        best = jnp.maximum(force[k] + short / one.stiffness, 0.0)
        best = jnp.where(one.distance < 0.0, best, 0.0)
        more = motion.mobility * (best - force[k])
        motion = motion._replace(x=motion.x + more * one.x, y=motion.y + more * one.y)
        found.append(best)
    return jnp.stack(found), motion
