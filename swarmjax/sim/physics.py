"""MJX: many arenas' rigid bodies on one device, by `impl=jax` or `impl=warp`.

The state of an arena is `PhysicsState`: positions, velocities and the solver's warm start, the
same for both implementations and all that a step reads. Inside a rollout the whole `mjx.Data` is
carried instead, because rebuilding it at every control step costs a quarter of the speed.
"""

import contextlib
import importlib.util
import io
from dataclasses import dataclass
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from swarmjax.config import ConfigError, RobotConfig
from swarmjax.sim import model as sim_model
from swarmjax.sim.body import AS_BUILT, Body, Chassis

with contextlib.redirect_stdout(io.StringIO()):  # it prints twice where Warp is not installed
    from mujoco import mjx

# Newton iterations and line-search steps; see docs/design.md for what was measured.
SOLVER_STEPS = {
    ("planar", "jax"): (3, 5),
    ("wheeled", "jax"): (30, 20),
    ("planar", "warp"): (100, 50),
    ("wheeled", "warp"): (100, 50),
}
# Contacts between hulls and what they touch are stored for all arenas together by Warp: an average
# of this many a robot is far more than a swarm makes; each arena alone may have
# SOLVER_ROWS_PER_ROBOT. What stands on the floor is counted apart, and whole.
CONTACTS_PER_ROBOT = 3
SOLVER_ROWS_PER_ROBOT = 6  # neighbours that a disc can touch at once


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
      model: the MJX model.
      host: the same, compiled by MuJoCo.
      template: an `mjx.Data` to fill in.
      ids: rows of the moving bodies.
      robot: the robot's numbers.
      substeps: physics steps per control step.
    """

    model: mjx.Model
    host: mujoco.MjModel
    template: mjx.Data
    ids: sim_model.Ids
    robot: RobotConfig
    substeps: int

    @property
    def body(self) -> Body:
        """The robots' kind of body."""
        return sim_model.BODIES[self.robot.body]


def resolve_impl(impl: str) -> str:
    """Turns `auto` into `warp` on an NVIDIA GPU that has Warp, `jax` elsewhere.

    Args:
      impl: `auto`, `jax` or `warp`.

    Returns:
      `jax` or `warp`.

    Raises:
      ConfigError: if Warp is asked for and not installed.
    """
    installed = importlib.util.find_spec("warp") is not None
    if impl == "warp" and not installed:
        raise ConfigError(
            "sim.impl is warp, but Warp is not installed: give jax or auto, or install extra gpu."
        )
    if impl != "auto":
        return impl
    return "warp" if installed and jax.default_backend() == "gpu" else "jax"


def load(
    model: mujoco.MjModel,
    ids: sim_model.Ids,
    robot: RobotConfig,
    *,
    impl: str,
    arenas: int,
    substeps: int,
) -> Physics:
    """Puts a model on the device.

    Args:
      model: one arena; its solver iterations are taken from here.
      ids: rows of the moving bodies.
      robot: the robot's numbers.
      impl: `jax` or `warp`.
      arenas: how many arenas will be stepped together (Warp shares its contact memory).
      substeps: physics steps per control step.

    Returns:
      The physics of a program.
    """
    limits = {}
    if impl == "warp":
        _quiet_warp()
        limits = _limits(model, len(ids.hull_body), arenas)
    template = mjx.make_data(model, impl=impl, **limits)
    device_model = mjx.put_model(model, impl=impl)
    return Physics(device_model, model, template, ids, robot, substeps)


def _limits(model: mujoco.MjModel, robots: int, arenas: int) -> dict[str, int]:
    """Room for contacts: of all arenas together, and for the solver's rows of each one."""
    on_floor = model.geom_type[model.pair_geom1] == mujoco.mjtGeom.mjGEOM_PLANE
    rows = np.where(model.pair_dim[on_floor] == 1, 1, 2 * (model.pair_dim[on_floor] - 1))
    others = min(int(np.sum(~on_floor)), SOLVER_ROWS_PER_ROBOT * robots)
    return {
        "naconmax": arenas * (CONTACTS_PER_ROBOT * robots + int(np.sum(on_floor))),
        "njmax": others + int(np.sum(rows)),
    }


def _quiet_warp() -> None:
    """Stops Warp from printing its banner and the name of every kernel it loads."""
    import warp

    warp.config.log_level = warp.LOG_ERROR


def build_kernels(physics: Physics, states: PhysicsState) -> None:
    """Makes Warp build its kernels, which it does at its first step: half a minute on a new card.

    Args:
      physics: the compiled side, `impl` warp.
      states: [A] arenas; as many as the program will step, since contacts are sized for them.
    """

    def step_once(state: PhysicsState) -> Array:
        return mjx.step(physics.model, unpack(physics, state)).qpos

    jax.block_until_ready(jax.jit(jax.vmap(step_once))(states))


def rest(physics: Physics, pose: Array) -> PhysicsState:
    """Returns robots at rest at poses [R, 3], x (m), y (m), yaw (rad)."""
    still = jnp.zeros(physics.host.nv)
    return PhysicsState(physics.body.qpos(pose, jnp), still, still)


def unpack(physics: Physics, state: PhysicsState) -> mjx.Data:
    """Fills an `mjx.Data` of one arena in, to carry through a rollout."""
    return physics.template.replace(**state._asdict())


def pack(data: mjx.Data) -> PhysicsState:
    """Keeps of an `mjx.Data` what is physically the state."""
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)


def poses(physics: Physics, data: mjx.Data | PhysicsState) -> Array:
    """Returns [R, 3] x (m), y (m), yaw (rad) of the robots."""
    return physics.body.pose(data.qpos, jnp)


def is_finite(data: mjx.Data) -> Array:
    """Returns [] whether the arena's physics is still sound."""
    return jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all()


def step(
    physics: Physics,
    data: mjx.Data,
    side: Array,
    obstacle: Array,
    wheels: Array,
    chassis: Chassis = AS_BUILT,
) -> mjx.Data:
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
    ids = physics.ids
    chex.assert_rank(side, 0)
    chex.assert_shape(obstacle, (len(ids.obstacle_geom), 5))
    chex.assert_shape(wheels, (len(ids.hull_body), 2))
    place, turn = sim_model.fixture_poses(side, obstacle, jnp)
    data = data.replace(
        mocap_pos=data.mocap_pos.at[ids.fixture_mocap].set(place),
        mocap_quat=data.mocap_quat.at[ids.fixture_mocap].set(turn),
        ctrl=physics.body.ctrl(wheels, chassis, physics.robot, jnp),
    )
    model = _change(physics, obstacle, chassis)
    if physics.substeps == 1:
        return mjx.step(model, data)
    return jax.lax.fori_loop(0, physics.substeps, lambda _, d: mjx.step(model, d), data)


def _change(physics: Physics, obstacle: Array, chassis: Chassis) -> mjx.Model:
    """Sets what this arena's model has of its own."""
    model, ids = physics.model, physics.ids
    fields = {"geom_size": model.geom_size.at[ids.obstacle_geom, :2].set(obstacle[:, 3:])}
    changes = physics.body.changes(chassis, ids.robots, physics.robot, physics.host)
    for name, (rows, values) in changes.items():
        fields[name] = jnp.asarray(fields.get(name, getattr(model, name))).at[rows].set(values)
    return model.replace(**fields)
