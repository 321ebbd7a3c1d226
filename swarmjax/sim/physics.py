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
from jax import Array

from swarmjax.config import ConfigError
from swarmjax.sim import model as sim_model

with contextlib.redirect_stdout(io.StringIO()):  # it prints twice where Warp is not installed
    from mujoco import mjx

# Newton iterations and line-search steps; see docs/design.md for what was measured.
SOLVER_STEPS = {"jax": (3, 5), "warp": (100, 50)}
# Contacts are stored for all arenas together by Warp: an average of this many a robot is far more
# than a swarm makes; each arena alone may have SOLVER_ROWS_PER_ROBOT.
CONTACTS_PER_ROBOT = 3
SOLVER_ROWS_PER_ROBOT = 6  # neighbours that a disc can touch at once


class PhysicsState(NamedTuple):
    """What is physically the state of an arena (or, with a leading axis, of many).

    Attributes:
      qpos: [3R] x (m), y (m), yaw (rad, unbounded) of each robot in turn.
      qvel: [3R] their rates.
      qacc_warmstart: [3R] where the solver starts.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array


@dataclass(frozen=True, eq=False)
class Physics:
    """The compiled side of the physics: fixed for a program.

    Attributes:
      model: the MJX model.
      template: an `mjx.Data` to fill in.
      ids: rows of the moving bodies.
      substeps: physics steps per control step.
    """

    model: mjx.Model
    template: mjx.Data
    ids: sim_model.Ids
    substeps: int


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
    model: mujoco.MjModel, ids: sim_model.Ids, *, impl: str, arenas: int, substeps: int
) -> Physics:
    """Puts a model on the device.

    Args:
      model: one arena; its solver iterations are taken from here.
      ids: rows of the moving bodies.
      impl: `jax` or `warp`.
      arenas: how many arenas will be stepped together (Warp shares its contact memory).
      substeps: physics steps per control step.

    Returns:
      The physics of a program.
    """
    limits = {}
    if impl == "warp":
        _quiet_warp()
        robots = len(ids.hull_body)
        limits = {
            "naconmax": arenas * CONTACTS_PER_ROBOT * robots,
            "njmax": min(model.npair, SOLVER_ROWS_PER_ROBOT * robots),
        }
    template = mjx.make_data(model, impl=impl, **limits)
    device_model = mjx.put_model(model, impl=impl)
    return Physics(device_model, template, ids, substeps)


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


def rest(qpos: Array) -> PhysicsState:
    """Returns a state at rest at `qpos` [3R]."""
    return PhysicsState(qpos, jnp.zeros_like(qpos), jnp.zeros_like(qpos))


def unpack(physics: Physics, state: PhysicsState) -> mjx.Data:
    """Fills an `mjx.Data` of one arena in, to carry through a rollout."""
    return physics.template.replace(**state._asdict())


def pack(data: mjx.Data) -> PhysicsState:
    """Keeps of an `mjx.Data` what is physically the state."""
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)


def poses(data: mjx.Data | PhysicsState) -> Array:
    """Returns [R, 3] x (m), y (m), yaw (rad) of the robots."""
    return data.qpos.reshape(-1, 3)


def is_finite(data: mjx.Data) -> Array:
    """Returns [] whether the arena's physics is still sound."""
    return jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all()


def step(
    physics: Physics, data: mjx.Data, side: Array, obstacle: Array, velocity: Array
) -> mjx.Data:
    """Moves one arena on by one control step.

    Args:
      physics: the compiled side.
      data: the arena.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      velocity: [R, 2] forward speed (m/s) and turn rate (rad/s) that the servos hold.

    Returns:
      The arena, one control step later.
    """
    ids = physics.ids
    chex.assert_rank(side, 0)
    chex.assert_shape(obstacle, (len(ids.obstacle_geom), 5))
    chex.assert_shape(velocity, (len(ids.hull_body), 2))
    place, turn = sim_model.fixture_poses(side, obstacle, jnp)
    forward, turn_rate = velocity[:, 0], velocity[:, 1]
    ctrl = jnp.stack([forward, jnp.zeros_like(forward), turn_rate], axis=-1).reshape(-1)
    data = data.replace(
        mocap_pos=data.mocap_pos.at[ids.fixture_mocap].set(place),
        mocap_quat=data.mocap_quat.at[ids.fixture_mocap].set(turn),
        ctrl=ctrl,
    )
    model = physics.model
    model = model.replace(geom_size=model.geom_size.at[ids.obstacle_geom, :2].set(obstacle[:, 3:]))
    if physics.substeps == 1:
        return mjx.step(model, data)
    return jax.lax.fori_loop(0, physics.substeps, lambda _, d: mjx.step(model, d), data)
