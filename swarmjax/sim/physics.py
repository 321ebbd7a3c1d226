"""Many arenas' rigid bodies on one device: MJX, by `impl=jax` or `impl=warp`.

The state of an arena is `PhysicsState`: positions, velocities and the solver's warm start, the
same for every engine and all that a step reads. Inside a rollout the engine's whole data is
carried instead, because rebuilding it at every control step costs a quarter of the speed.
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

# Where a rotation about the z axis has cosines, sines and ones.
_COSINES = np.diag([1.0, 1.0, 0.0]).astype(np.float32)
_SINES = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], np.float32)
_ONES = np.diag([0.0, 0.0, 1.0]).astype(np.float32)

Fields = dict[str, Array]


class PhysicsState(NamedTuple):
    """What is physically the state of an arena (or, with a leading axis, of many).

    Attributes:
      qpos: [Q] positions of the joints, each robot in turn, as its body says.
      qvel: [V] their rates.
      qacc_warmstart: [V] where the solver starts.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array


@dataclass(frozen=True, eq=False)
class Physics:
    """The compiled side of the physics: fixed for a program.

    Attributes:
      engine: what takes the physics steps.
      host: the model as MuJoCo compiled it.
      ids: rows of the moving bodies.
      robot: the robot's numbers.
      substeps: physics steps per control step.
    """

    engine: Engine
    host: mujoco.MjModel
    ids: sim_model.Ids
    robot: RobotConfig
    substeps: int

    @property
    def body(self) -> Body:
        """The robots' kind of body."""
        return sim_model.BODIES[self.robot.body]


def build_kernels(physics: Physics, states: PhysicsState) -> None:
    """Makes Warp build MJX's kernels, which it does at their first step: half a minute, once.

    Args:
      physics: the compiled side, whose engine `builds_kernels`.
      states: [A] arenas; as many as the program will step, since contacts are sized for them.
    """

    def step_once(state: PhysicsState) -> Array:
        return sim_engine.import_mjx().step(physics.engine.model, unpack(physics, state)).qpos

    jax.block_until_ready(jax.jit(jax.vmap(step_once))(states))


def rest(physics: Physics, pose: Array) -> PhysicsState:
    """Returns robots at rest at poses [R, 3], x (m), y (m), yaw (rad)."""
    still = jnp.zeros(physics.host.nv)
    return PhysicsState(physics.body.qpos(pose, jnp), still, still)


def unpack(physics: Physics, state: PhysicsState) -> Data:
    """Fills the data of one arena in, to carry through a rollout."""
    return physics.engine.template.replace(**state._asdict())


def pack(data: Data) -> PhysicsState:
    """Keeps of the data what is physically the state."""
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)


def poses(physics: Physics, data: Data | PhysicsState) -> Array:
    """Returns [R, 3] x (m), y (m), yaw (rad) of the robots."""
    return physics.body.pose(data.qpos, jnp)


def is_finite(data: Data) -> Array:
    """Returns [] whether the arena's physics is still sound."""
    return jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all()


def step(
    physics: Physics,
    data: Data,
    side: Array,
    obstacle: Array,
    wheels: Array,
    chassis: Chassis = AS_BUILT,
) -> Data:
    """Moves one arena on by one control step.

    Args:
      physics: the compiled side.
      data: the arena.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      wheels: [R, 2] speeds of the left and right wheel that the motors hold, rad/s.
      chassis: of the robots, where it is not the config's.

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
    """Lets the servos act in the next physics step: as actuators, or as the forces that they are.

    Args:
      physics: the compiled side.
      data: the arena.
      ctrl: [R * U] as its body says.
      chassis: of the robots.

    Returns:
      The arena, with what acts on its joints from now until the physics step is over.
    """
    servos, timestep = physics.body.servos, physics.host.opt.timestep
    if servos is None:
        return data.replace(ctrl=ctrl)
    force = servos.force(data.qpos, data.qvel, ctrl, chassis, physics.robot, timestep, jnp)
    return data.replace(qfrc_applied=force)


def _fixtures(physics: Physics, side: Array, obstacle: Array) -> tuple[Fields, Fields]:
    """Puts this arena's obstacles and walls where the implementation looks for them.

    `jax` works the poses of all geoms out from the model. `warp` passes over those of the world,
    which stay in the data as they were made, or set here; it overwrites the poses of all others.
    An engine that is not MJX is told side and obstacles themselves.

    Args:
      physics: the compiled side.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      Fields of the model, and of the data.
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

    By a choice: `.at` under `vmap` is a scatter, and of a concatenation every part is a branch, all
    of which a GPU takes.
    """
    count, end = len(array), first + len(rows)
    row = np.arange(count).reshape(-1, *[1] * (array.ndim - 1))
    padded = jnp.pad(rows, [(first, count - end), *[(0, 0)] * (array.ndim - 1)])
    return jnp.where((row >= first) & (row < end), padded, array)


def _wall_matrices() -> np.ndarray:
    """Rotation matrices [4, 3, 3] of the walls."""
    turn = sim_model.fixture_poses(np.float32(0.0), np.zeros((0, 5), np.float32), np)[1]
    return _matrices(2.0 * np.arctan2(turn[:, 3], turn[:, 0]), np)


def _matrices(yaw: Any, xp: Any) -> Any:
    """Rotation matrices [F, 3, 3] about the z axis by angles [F], rad; no concatenation."""
    cos, sin = (angle[:, None, None] for angle in (xp.cos(yaw), xp.sin(yaw)))
    return cos * _COSINES + sin * _SINES + _ONES


def _change(physics: Physics, fields: Fields, chassis: Chassis) -> Model:
    """Sets what this arena's model has of its own: these fields, and the chassis."""
    model, rows_of = physics.engine.model, physics.ids.robots
    changes = physics.body.changes(chassis, rows_of, physics.robot, physics.host)
    if not physics.engine.is_mjx:  # then the model has only the fields that are read
        changes = {
            name: changes[name] for name in changes if getattr(model, name, None) is not None
        }
    for name, (rows, values) in changes.items():
        now = jnp.asarray(fields.get(name, getattr(model, name)))
        fields = fields | {name: now.at[rows].set(values)}
    return model.replace(**fields)
