"""Planar robots as discs: a physics step without bodies in space.

A hull is a sphere between upright faces, so in the plane it is a disc, and its contacts (condim 1)
push through its centre: they move it along x and y and never turn it. MJX's own step builds every
contact in space and factorises one matrix for all robots at every iteration of Newton's method;
that is nine tenths of it. What robots push with is MuJoCo's convex problem in its dual form
(MuJoCo's documentation, Computation, "Dual problem"),

    minimise over f >= 0:  1/2 f' (J M^-1 J' + R) f + f' (J a0 - aref),

which has as many unknowns as there are contacts, mostly none. Projected Gauss-Seidel, MuJoCo's own
second solver, PGS, goes through them one by one,

    f_i <- max(0, f_i + (aref_i - J_i a - R_i f_i) / (J_i M^-1 J_i' + R_i)),

a always being the acceleration that the forces of now bring about, and ends where Newton's method
does: there is one minimum. `planar_jax` does so by JAX, `planar_warp` by Warp. A sweep
goes through the fixtures one by one, for all robots, and then through the pairs of robots.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.engine import Engine
from swarmjax.sim.geometry import CONTACT_HEIGHT

# Share of the largest force by which any may still change; float32 rounds at 1e-7.
TOLERANCE = 1e-6
# A centre that is deeper within a box than it is below its top or above its bottom, m, is pushed
# up or down by MuJoCo, where no joint gives way.
DEEPEST = min(CONTACT_HEIGHT, 2.0 * sim_model.HALF_HEIGHT - CONTACT_HEIGHT)


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
      solve: how robots accelerate with their contacts: `push_apart` of a solver, of these, the
        robots of an arena, its side [] (m) and obstacles [M, 5] (x, y, yaw, half edges).
    """

    radius: float
    timestep: float
    sweeps: int
    body: np.ndarray
    opponent: np.ndarray
    solref: np.ndarray
    solimp: np.ndarray
    solve: "Solve"


@struct.dataclass
class Model:
    """What is read of a model, by MuJoCo's names.

    Attributes:
      body_mass: [B] kg.
      body_inertia: [B, 3] kg m^2.
      body_invweight0: [B, 2] 1 / kg, 1 / (kg m^2).
      pair_friction: [P, 5] all alike, of which the first two are along the face; None where hulls
        have none.
    """

    body_mass: Array
    body_inertia: Array
    body_invweight0: Array
    pair_friction: Array | None = None


@struct.dataclass
class Data:
    """What changes in an arena, by MuJoCo's names.

    Attributes:
      qpos: [Q] x (m), y (m), yaw (rad) of each robot in turn.
      qvel: [V] their rates.
      qacc_warmstart: [V] the rates' rates in the step before.
      qfrc_applied: [V] N, N, N m, all that acts but contacts.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    qfrc_applied: Array


class Rubbing(NamedTuple):
    """What friction needs to know besides, of an arena, or of many with a leading axis.

    Attributes:
      agility: [R] 1 / moment of inertia, 1 / (kg m^2).
      friction: [] of hulls on what they touch.
    """

    agility: Array
    friction: Array


class DiscRobots(NamedTuple):
    """The robots of an arena, or of many with a leading axis.

    Attributes:
      place: [R, 3] x (m), y (m), yaw (rad).
      rate: [R, 3] of it, 1/s.
      free: [R, 3] of the rate, 1/s^2, without contacts.
      before: [R, 3] of the rate, 1/s^2, in the step before.
      mobility: [R] 1 / mass, 1 / kg.
      weight: [R] MuJoCo's inverse weight, 1 / kg.
      rubbing: None where hulls have no friction.
    """

    place: Array
    rate: Array
    free: Array
    before: Array
    mobility: Array
    weight: Array
    rubbing: Rubbing | None = None


Solve = Callable[[Discs, DiscRobots, Array, Array], Array]


def load(model: mujoco.MjModel, ids: sim_model.Ids, radius: float, solve: Solve) -> Discs:
    """Takes what a step needs from a model of planar robots.

    Args:
      model: compiled, one arena.
      ids: where things lie in it.
      radius: of the hulls, m.
      solve: `push_apart` of the solver for these hulls.

    Returns:
      What is fixed for a program.
    """
    solref, solimp = np.unique(model.pair_solref, axis=0), np.unique(model.pair_solimp, axis=0)
    assert len(solref) == len(solimp) == 1
    assert solref.min() > 0.0  # otherwise it means stiffness and damping
    rounds = _rounds(len(ids.hull_body))
    of_model = model.opt.timestep, model.opt.iterations, ids.hull_body
    assert model.opt.impratio == 1.0  # contacts are as soft along the face as along the normal
    return Discs(radius, *of_model, rounds, solref[0], solimp[0], solve)


def rubs(model: mujoco.MjModel) -> bool:
    """Tells whether the model's hulls have friction."""
    return bool((model.pair_dim > 1).any())


def put(model: mujoco.MjModel) -> tuple[Model, Data]:
    """Puts what a step reads on the device.

    Args:
      model: compiled, one arena.

    Returns:
      The model, and an arena at 0 to fill in.
    """
    fields = model.body_mass, model.body_inertia, model.body_invweight0
    still = jnp.zeros(model.nv)
    friction = jnp.asarray(model.pair_friction) if rubs(model) else None
    placed = Model(*map(jnp.asarray, fields), pair_friction=friction)
    return placed, Data(jnp.zeros(model.nq), still, still, still)


def load_engine(model: mujoco.MjModel, ids: sim_model.Ids, radius: float, solve: Solve) -> Engine:
    """Loads the discs as what takes a program's physics steps.

    Args:
      model: compiled, one arena.
      ids: where things lie in it.
      radius: of the hulls, m.
      solve: `push_apart` of the solver for these hulls.

    Returns:
      The engine.
    """
    discs = load(model, ids, radius, solve)
    # Speeds of the environment: README.md, "What steps the robots".
    label = (
        "discs, swarmjax's own step of the MJX model in the plane (2.4 times as fast as "
        "sim.solver=mjx on two cores, 3.9 times on an H200)"
    )
    return Engine(label, *put(model), functools.partial(step, discs), is_mjx=False)


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


def step(discs: Discs, model: Model, data: Data, side: Array, obstacle: Array) -> Data:
    """Moves one arena on by one physics step (MuJoCo's semi-implicit Euler).

    Args:
      discs: what is fixed.
      model: of which masses and inverse weights are read.
      data: the arena; `qfrc_applied` is all that acts on it but contacts.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      The arena, one step later.
    """
    robots = _robots(discs, model, data)
    acceleration = discs.solve(discs, robots, side, obstacle).reshape(-1)
    velocity = data.qvel + discs.timestep * acceleration
    return replace(
        data,
        qpos=data.qpos + discs.timestep * velocity,
        qvel=velocity,
        qacc_warmstart=acceleration,
    )


def _robots(discs: Discs, model: Model, data: Data) -> DiscRobots:
    """The robots of an arena."""
    mass, turn = model.body_mass[discs.body], model.body_inertia[discs.body, 2]
    fields = data.qpos, data.qvel, data.qfrc_applied, data.qacc_warmstart
    place, rate, force, before = (field.reshape(-1, 3) for field in fields)
    free = force / jnp.stack([mass, mass, turn], axis=-1)
    robots = DiscRobots(place, rate, free, before, 1.0 / mass, model.body_invweight0[discs.body, 0])
    if model.pair_friction is None:
        return robots
    return robots._replace(rubbing=Rubbing(1.0 / turn, model.pair_friction[0, 0]))


def spring(discs: Discs) -> tuple[float, float]:
    """How contacts pull back, all alike.

    MuJoCo's documentation, Modeling, "Solver parameters": k and b of `solref`, which is at least
    two physics steps (`refsafe`).

    Args:
      discs: what is fixed.

    Returns:
      Stiffness, 1/s^2, and damping, 1/s.
    """
    constant, ratio = max(float(discs.solref[0]), 2.0 * discs.timestep), float(discs.solref[1])
    most = float(discs.solimp[1])
    return 1.0 / (most * constant * ratio) ** 2, 2.0 / (most * constant)
