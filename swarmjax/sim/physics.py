"""Steps the physics of many arenas on one device, with MJX or with a faster engine.

The state of an arena is `PhysicsState`: positions, velocities and the solver's warm start. These
fields are the same for every engine, and they are all that a physics step reads from its
predecessor. Within a rollout, the engine's complete data is carried from step to step, because
rebuilding the data from the state at every control step would cost a quarter of the speed.
"""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from swarmjax.sim import engine as sim_engine
from swarmjax.sim import model as sim_model
from swarmjax.sim.body import AS_BUILT, Body, Chassis
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.engine import Data, Engine, Model

# Where a rotation matrix about the z axis has cosines, sines and a one.
_COSINES = np.diag([1.0, 1.0, 0.0]).astype(np.float32)
_SINES = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], np.float32)
_ONES = np.diag([0.0, 0.0, 1.0]).astype(np.float32)

Fields = dict[str, Array]


class PhysicsState(NamedTuple):
    """Physical state of an arena, or of many arenas with a leading axis.

    Attributes:
      qpos: [Q] joint positions of one robot after the other, in the layout of the robots' body.
      qvel: [V] joint velocities of one robot after the other.
      qacc_warmstart: [V] accelerations from which the solver starts.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array


@dataclass(frozen=True, eq=False)
class Physics:
    """The compiled physics, constant within a compiled program.

    Attributes:
      engine: takes the physics steps.
      host: the model as compiled by MuJoCo.
      ids: rows of robots, obstacles and walls in the model.
      robot: settings of the robot.
      substeps: physics steps per control step.
    """

    engine: Engine
    host: mujoco.MjModel
    ids: sim_model.Ids
    robot: RobotConfig
    substeps: int

    @property
    def body(self) -> Body:
        """The functions of the robots' kind of body."""
        return sim_model.BODIES[self.robot.body]


def build_kernels(physics: Physics, states: PhysicsState) -> None:
    """Makes Warp build MJX's kernels now and not at the first step; this takes half a minute.

    Args:
      physics: the compiled physics, whose engine has `builds_kernels` true.
      states: states of A arenas. A must be the number of arenas that the program will step, since
        the size of the contact memory depends on it.
    """

    def step_once(state: PhysicsState) -> Array:
        return sim_engine.import_mjx().step(physics.engine.model, unpack(physics, state)).qpos

    jax.block_until_ready(jax.jit(jax.vmap(step_once))(states))


def rest(physics: Physics, pose: Array) -> PhysicsState:
    """Returns the state of robots at rest at poses [R, 3]: x (m), y (m), yaw (rad)."""
    still = jnp.zeros(physics.host.nv)
    return PhysicsState(physics.body.qpos(pose, jnp), still, still)


def unpack(physics: Physics, state: PhysicsState) -> Data:
    """Converts the state of one arena to the engine's data, which a rollout carries."""
    return physics.engine.template.replace(**state._asdict())


def pack(data: Data) -> PhysicsState:
    """Extracts the physical state from the engine's data."""
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)


def poses(physics: Physics, data: Data | PhysicsState) -> Array:
    """Returns the robots' poses [R, 3]: x (m), y (m), yaw (rad)."""
    return physics.body.pose(data.qpos, jnp)


def is_finite(data: Data) -> Array:
    """Returns whether all positions and velocities of the arena are finite, []."""
    return jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all()


def step(
    physics: Physics,
    data: Data,
    side: Array,
    obstacle: Array,
    wheels: Array,
    chassis: Chassis = AS_BUILT,
) -> Data:
    """Advances one arena by one control step.

    Args:
      physics: the compiled physics.
      data: the arena.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      wheels: [R, 2] speeds of the left and right wheel during this control step, rad/s.
      chassis: properties in which the robots differ from the config.

    Returns:
      The arena, one control step later.
    """
    chex.assert_rank(side, 0)
    chex.assert_shape(obstacle, (len(physics.ids.obstacle_geom), 5))
    chex.assert_shape(wheels, (len(physics.ids.hull_body), 2))
    of_model, of_data = _fixtures(physics, side, obstacle)
    model = _change(physics, of_model, chassis)
    ctrl = physics.body.ctrl(wheels, chassis, physics.robot, jnp)
    data = data.replace(**of_data)

    def once(_: int, data: Data) -> Data:
        driven = _drive(physics, data, ctrl, chassis)
        return physics.engine.step(model, driven, side, obstacle)

    if physics.substeps == 1:
        return once(0, data)
    return jax.lax.fori_loop(0, physics.substeps, once, data)


def _drive(physics: Physics, data: Data, ctrl: Array, chassis: Chassis) -> Data:
    """Sets the controls of actuators, or the forces of servos, for the next physics step.

    Args:
      physics: the compiled physics.
      data: the arena.
      ctrl: [R * U] controls, in the body's layout.
      chassis: chassis of the robots.

    Returns:
      The arena's data with these controls or forces.
    """
    servos, timestep = physics.body.servos, physics.host.opt.timestep
    if servos is None:
        return data.replace(ctrl=ctrl)
    force = servos.force(data.qpos, data.qvel, ctrl, chassis, physics.robot, timestep, jnp)
    return data.replace(qfrc_applied=force)


def _fixtures(physics: Physics, side: Array, obstacle: Array) -> tuple[Fields, Fields]:
    """Writes the poses and sizes of obstacles and walls into the fields that the engine reads.

    With `impl=jax`, MJX computes the poses of all geoms from the model, so the poses are set in the
    model. With `impl=warp`, MJX does not compute the poses of geoms of the world, so these poses
    are set in the data; MJX still overwrites the poses of all other geoms. An engine other than MJX
    takes side and obstacles as arguments, so nothing is set.

    Args:
      physics: the compiled physics.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      The new fields of the model, and the new fields of the data.
    """
    if not physics.engine.is_mjx:
        return {}, {}
    model, made = physics.engine.model, physics.engine.template
    first = int(physics.ids.fixture_geom[0])
    put = functools.partial(_with_rows, first=first)
    place, turn = sim_model.fixture_poses(side, obstacle, jnp)
    middle = place + np.array([0.0, 0.0, sim_model.HALF_HEIGHT], np.float32)
    half = jnp.pad(obstacle[:, 3:], ((0, 0), (0, 1)), constant_values=sim_model.HALF_HEIGHT)
    sizes = {"geom_size": put(model.geom_size, half)}
    if model.impl.value == "warp":
        walled = _with_rows(made.geom_xmat, _wall_matrices(), first + len(obstacle))
        matrix = put(walled, _matrices(obstacle[:, 2], jnp))
        return sizes, {"geom_xpos": put(made.geom_xpos, middle), "geom_xmat": matrix}
    poses = {"geom_pos": put(model.geom_pos, middle), "geom_quat": put(model.geom_quat, turn)}
    return sizes | poses, {}


def _with_rows(array: Array, rows: Any, first: int) -> Array:
    """Replaces the rows from `first` on.

    The function uses `where`, because `.at` would become a scatter under `vmap`. A concatenation
    would become a kernel with one branch per part, and a GPU would execute all branches.
    """
    count, end = len(array), first + len(rows)
    row = np.arange(count).reshape(-1, *[1] * (array.ndim - 1))
    padded = jnp.pad(rows, [(first, count - end), *[(0, 0)] * (array.ndim - 1)])
    return jnp.where((row >= first) & (row < end), padded, array)


def _wall_matrices() -> np.ndarray:
    """Returns the rotation matrices [4, 3, 3] of the walls."""
    turn = sim_model.fixture_poses(np.float32(0.0), np.zeros((0, 5), np.float32), np)[1]
    return _matrices(2.0 * np.arctan2(turn[:, 3], turn[:, 0]), np)


def _matrices(yaw: Any, xp: Any) -> Any:
    """Returns rotation matrices [F, 3, 3] about the z axis by angles [F], without concatenation."""
    cos, sin = (angle[:, None, None] for angle in (xp.cos(yaw), xp.sin(yaw)))
    return cos * _COSINES + sin * _SINES + _ONES


def _change(physics: Physics, fields: Fields, chassis: Chassis) -> Model:
    """Returns the model with the values of one arena: `fields`, and the changes by the chassis."""
    model, rows_of = physics.engine.model, physics.ids.robots
    changes = physics.body.changes(chassis, rows_of, physics.robot, physics.host)
    if not physics.engine.is_mjx:  # such a model may lack fields
        changes = {
            name: changes[name] for name in changes if getattr(model, name, None) is not None
        }
    for name, (rows, values) in changes.items():
        now = jnp.asarray(fields.get(name, getattr(model, name)))
        fields = fields | {name: now.at[rows].set(values)}
    return model.replace(**fields)
