"""Steps the physics of planar robots as discs in the plane.

A hull is a sphere between upright faces, so in the plane it is a disc. A contact without friction
(condim 1) pushes through the disc's centre, so it never turns the disc. MJX's own step does more:
it builds every contact in three dimensions, and at every iteration of Newton's method it factorises
one matrix for all robots. These two tasks take nine tenths of that step's time. The contact forces
are the solution of MuJoCo's convex problem in its dual form (MuJoCo's documentation, Computation,
"Dual problem"),

    minimise over f >= 0:  1/2 f' (J M^-1 J' + R) f + f' (J a0 - aref).

The dual form has one unknown per contact, and most states have no contact. Projected Gauss-Seidel
(MuJoCo's second solver, PGS) updates the forces one by one,

    f_i <- max(0, f_i + (aref_i - J_i a - R_i f_i) / (J_i M^-1 J_i' + R_i)),

where a is the acceleration under the current forces. The problem has a single minimum, so PGS and
Newton's method reach the same solution. `planar_jax` implements PGS in JAX, `planar_warp` in Warp.
A sweep updates each force once: it goes through the fixtures (obstacles and walls) one by one, each
for all robots, and then through the pairs of robots.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.engine import Engine
from swarmjax.sim.geometry import CONTACT_HEIGHT

# Sweeps stop when no force changes by more than this share of the largest force. float32 rounds at
# 1e-7.
TOLERANCE = 1e-6
# m; vertical distance from a hull's centre to a box's top or bottom, whichever is nearer. If a
# centre lies deeper than this behind the box's sides, MuJoCo pushes it up or down, and no joint
# moves in these directions.
DEEPEST = min(CONTACT_HEIGHT, 2.0 * sim_model.HALF_HEIGHT - CONTACT_HEIGHT)


class Discs(NamedTuple):
    """Constants of a compiled program.

    Attributes:
      radius: radius of the hulls, m.
      timestep: one physics step, s.
      sweeps: largest number of sweeps in a physics step.
      body: [R] rows of the hulls among the model's bodies.
      opponent: [N, R] index of the robot with which each robot forms a pair in each of N rounds
        (see `_rounds`); its own index if it has no partner in that round.
      solref: time constant (s) and damping ratio of all contacts.
      solimp: impedance of all contacts: smallest, largest, width (m), midpoint, power.
      friction: friction between hulls and everything that they touch; 0 for none.
      solve: the function `push_apart` of a solver. It takes these constants, the robots of an
        arena, the arena's side [] (m) and its obstacles [M, 5] (x, y, yaw, half edges). It returns
        the robots' accelerations including contacts.
    """

    radius: float
    timestep: float
    sweeps: int
    body: np.ndarray
    opponent: np.ndarray
    solref: np.ndarray
    solimp: np.ndarray
    friction: np.float32
    solve: "Solve"


@struct.dataclass
class Model:
    """The fields of a model that a step reads, with MuJoCo's names.

    Attributes:
      body_mass: [B] kg.
      body_inertia: [B, 3] kg m^2.
      body_invweight0: [B, 2] 1 / kg, 1 / (kg m^2).
    """

    body_mass: Array
    body_inertia: Array
    body_invweight0: Array


@struct.dataclass
class Data:
    """The fields of an arena that change in a step, with MuJoCo's names.

    Attributes:
      qpos: [Q] x (m), y (m), yaw (rad) of each robot in turn.
      qvel: [V] velocities of the robots in the order of `qpos`, m/s, m/s, rad/s.
      qacc_warmstart: [V] accelerations in the previous step.
      qfrc_applied: [V] sums of all forces and torques except those of contacts, N, N, N m.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    qfrc_applied: Array


class DiscRobots(NamedTuple):
    """The robots of an arena, or of many arenas with a leading axis.

    Attributes:
      place: [R, 3] x (m), y (m), yaw (rad).
      rate: [R, 3] rate of change of `place`, m/s, m/s, rad/s.
      free: [R, 3] acceleration of `place` without contacts, m/s^2, m/s^2, rad/s^2.
      before: [R, 3] acceleration of `place` in the previous step, m/s^2, m/s^2, rad/s^2.
      mobility: [R] 1 / mass, 1 / kg.
      weight: [R] MuJoCo's inverse weight (`body_invweight0`), 1 / kg.
      agility: [R] 1 / moment of inertia, 1 / (kg m^2); only solvers with friction use it.
    """

    place: Array
    rate: Array
    free: Array
    before: Array
    mobility: Array
    weight: Array
    agility: Array


Solve = Callable[[Discs, DiscRobots, Array, Array], Array]


def load(model: mujoco.MjModel, ids: sim_model.Ids, radius: float, solve: Solve) -> Discs:
    """Extracts the constants of a step from a model of planar robots.

    Args:
      model: compiled, one arena.
      ids: rows of objects in the model.
      radius: radius of the hulls, m.
      solve: `push_apart` of the solver for these hulls.

    Returns:
      The constants of a program.
    """
    solref, solimp = np.unique(model.pair_solref, axis=0), np.unique(model.pair_solimp, axis=0)
    assert len(solref) == len(solimp) == 1
    assert solref.min() > 0.0  # negative values mean stiffness and damping
    rounds = _rounds(len(ids.hull_body))
    of_model = model.opt.timestep, model.opt.iterations, ids.hull_body
    assert model.opt.impratio == 1.0  # contacts are as soft along the face as along the normal
    friction = np.float32(model.pair_friction[0, 0] if rubs(model) else 0.0)
    return Discs(radius, *of_model, rounds, solref[0], solimp[0], friction, solve)


def rubs(model: mujoco.MjModel) -> bool:
    """Returns whether the model's hulls have friction."""
    return bool((model.pair_dim > 1).any())


def load_engine(model: mujoco.MjModel, ids: sim_model.Ids, radius: float, solve: Solve) -> Engine:
    """Creates the engine for discs.

    Args:
      model: compiled, one arena.
      ids: rows of objects in the model.
      radius: radius of the hulls, m.
      solve: `push_apart` of the solver for these hulls.

    Returns:
      The engine.
    """
    discs = load(model, ids, radius, solve)
    # The label gives speeds of the whole environment, not of the physics alone.
    label = (
        "discs, swarmjax's own planar step of the MJX model (2.4 times as fast as "
        "sim.solver=mjx on two cores, 3.9 times on an H200)"
    )
    fields = (np.float32(getattr(model, name)) for name in Model.__annotations__)
    # Copy NumPy arrays: `jnp.zeros` and `jnp.asarray` would be programs that a GPU has to load
    # first.
    *fields, still = jax.device_put((*fields, np.zeros(model.nv, np.float32)))
    data = Data(still, still, still, still)  # planar robots have as many positions as velocities
    return Engine(label, Model(*fields), data, functools.partial(step, discs), is_mjx=False)


def _rounds(robots: int) -> np.ndarray:
    """Splits the pairs of robots into rounds, in which each robot is in at most one pair, [N, R].

    This is the circle method for tournaments. With an odd number N of robots, robots i and j form a
    pair in round (i + j) modulo N. The robot left over in a round has no partner and gets its own
    index. With an even number of robots, the last robot is the partner of the robot left over.
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
    """Advances one arena by one physics step (MuJoCo's semi-implicit Euler).

    Args:
      discs: constants.
      model: provides masses and inverse weights.
      data: the arena; `qfrc_applied` holds all forces except contact forces.
      side: [] side of the arena, m.
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
    """Returns the robots of an arena."""
    mass, turn = model.body_mass[discs.body], model.body_inertia[discs.body, 2]
    fields = data.qpos, data.qvel, data.qfrc_applied, data.qacc_warmstart
    place, rate, force, before = (field.reshape(-1, 3) for field in fields)
    free = force / jnp.stack([mass, mass, turn], axis=-1)
    weight = model.body_invweight0[discs.body, 0]
    return DiscRobots(place, rate, free, before, 1.0 / mass, weight, 1.0 / turn)


def spring(discs: Discs) -> tuple[float, float]:
    """Returns stiffness and damping, which are the same for all contacts.

    These are k and b in MuJoCo's documentation (Modeling, "Solver parameters"), computed from
    `solref`. A time constant in `solref` of less than two physics steps is raised to two
    (`refsafe`).

    Args:
      discs: constants.

    Returns:
      Stiffness, 1/s^2, and damping, 1/s.
    """
    constant, ratio = max(float(discs.solref[0]), 2.0 * discs.timestep), float(discs.solref[1])
    most = float(discs.solimp[1])
    return 1.0 / (most * constant * ratio) ** 2, 2.0 / (most * constant)
