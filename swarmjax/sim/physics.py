"""Many arenas' rigid bodies on one device, by `impl=jax` or `impl=warp`: MJX, or `discs`.

The state of an arena is `PhysicsState`: positions, velocities and the solver's warm start, the
same for all and all that a step reads. Inside a rollout the whole `mjx.Data` (or `discs.Data`) is
carried instead, because rebuilding it at every control step costs a quarter of the speed.
"""

import contextlib
import copy
import functools
import importlib.util
import io
from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from swarmjax.config import ConfigError, RobotConfig
from swarmjax.sim import model as sim_model
from swarmjax.sim.body import AS_BUILT, Body, Chassis
from swarmjax.sim.fast import discs as sim_discs
from swarmjax.sim.fast import planar_jax

# Iterations and line-search steps at most; see docs/design.md for what was measured. MJX's Newton
# method by `jax` is cut off where it is near enough; all else has room to converge.
_NEWTON_STEPS = {"planar": (3, 5), "wheeled": (30, 20)}
_MOST_STEPS = (100, 50)  # MuJoCo's own
# Contacts between hulls and what they touch are stored for all arenas together by Warp: an average
# of this many a robot is far more than a swarm makes; each arena alone may have
# `discs.ROWS_PER_ROBOT`. What stands on the floor is counted apart, and whole.
CONTACTS_PER_ROBOT = 3
# In a jam of more wheeled robots the solver made for them leaves up to 7 mm/s (design.md, 38).
MOST_WHEELED = 5
FEW_ARENAS = 64  # in so few, all may be crowded at once: there is room for every pair
# Where a rotation about the z axis has cosines, sines and ones.
_COSINES = np.diag([1.0, 1.0, 0.0]).astype(np.float32)
_SINES = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], np.float32)
_ONES = np.diag([0.0, 0.0, 1.0]).astype(np.float32)

Fields = dict[str, Array]
# Of MJX, by either implementation, or of discs.
Model = Any
Data = Any


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
      model: MJX's, or the discs'.
      template: an `mjx.Data`, or the discs', to fill in.
      host: the model as MuJoCo compiled it.
      ids: rows of the moving bodies.
      robot: the robot's numbers.
      substeps: physics steps per control step.
      discs: what takes the physics steps in MJX's place; None: MJX does.
    """

    model: Model
    template: Data
    host: mujoco.MjModel
    ids: sim_model.Ids
    robot: RobotConfig
    substeps: int
    discs: sim_discs.Discs | None = None

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


def resolve_solver(solver: str, impl: str, body: str, robots: int) -> str:
    """Turns `auto` into `swarm` where that can be, `newton` elsewhere.

    Args:
      solver: `auto`, `newton` or `swarm`.
      impl: `jax` or `warp`.
      body: `planar` or `wheeled`.
      robots: that are compiled in.

    Returns:
      `newton` or `swarm`.

    Raises:
      ConfigError: if `swarm` is asked for where it cannot be.
    """
    if solver == "swarm" and body == "wheeled" and impl != "warp":
        raise ConfigError(
            f"sim.solver is swarm, but robot.body is wheeled and sim.impl is {impl}: give newton "
            "or auto, or sim.impl=warp."
        )
    if solver == "swarm" and body == "wheeled" and robots > MOST_WHEELED:
        raise ConfigError(
            f"sim.solver is swarm, but robot.body is wheeled and sim.max_robots is {robots}: give "
            f"newton or auto, or {MOST_WHEELED} robots at most."
        )
    if solver != "auto":
        return solver
    possible = body == "planar" or (impl == "warp" and robots <= MOST_WHEELED)
    return "swarm" if possible else "newton"


def solver_steps(solver: str, impl: str, body: str) -> tuple[int, int]:
    """Says how many iterations, and steps of their line search, a solver takes at most."""
    return _NEWTON_STEPS[body] if (solver, impl) == ("newton", "jax") else _MOST_STEPS


def load(
    model: mujoco.MjModel,
    ids: sim_model.Ids,
    robot: RobotConfig,
    *,
    impl: str,
    solver: str,
    arenas: int,
    substeps: int,
) -> Physics:
    """Puts a model on the device.

    Args:
      model: one arena; its solver iterations are taken from here.
      ids: rows of the moving bodies.
      robot: the robot's numbers.
      impl: `jax` or `warp`.
      solver: `newton` or `swarm`.
      arenas: how many arenas will be stepped together (Warp shares its contact memory).
      substeps: physics steps per control step.

    Returns:
      The physics of a program.
    """
    if impl == "warp":
        _quiet_warp()
    if solver == "swarm" and robot.body == "planar":
        discs = sim_discs.load(model, ids, robot.hull_radius, _push_apart(impl))
        return Physics(*sim_discs.put(model), model, ids, robot, substeps, discs)
    limits = _limits(model, len(ids.hull_body), arenas) if impl == "warp" else {}
    if solver == "swarm":
        model = copy.copy(model)
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # as wheeled_warp reads it
    mjx = _mjx()
    template = mjx.make_data(model, impl=impl, **limits)
    device_model = mjx.put_model(model, impl=impl)
    if solver == "swarm":
        device_model = _with_wheeled_solver(device_model)
    return Physics(device_model, template, model, ids, robot, substeps)


def _mjx() -> Any:
    """MJX, which takes two to four seconds to import, and is not needed where all are discs."""
    with contextlib.redirect_stdout(io.StringIO()):  # it prints twice where Warp is not installed
        from mujoco import mjx
    return mjx


def _push_apart(impl: str) -> sim_discs.Solve:
    """What solves for the contacts of discs."""
    if impl == "jax":
        return planar_jax.push_apart
    from swarmjax.sim.fast import planar_warp  # needs Warp

    return planar_warp.push_apart


def _with_wheeled_solver(model: Model) -> Model:
    """Lets a model be stepped by the solver that is made for wheeled robots."""
    from swarmjax.sim.fast import warp_step, wheeled_warp  # need Warp

    warp_step.install()
    return model.tree_replace({"opt.solver": wheeled_warp.NUMBER})


def _limits(model: mujoco.MjModel, robots: int, arenas: int) -> dict[str, int]:
    """Room for contacts: of all arenas together, and for the solver's rows of each one."""
    on_floor = model.geom_type[model.pair_geom1] == mujoco.mjtGeom.mjGEOM_PLANE
    rows = np.where(model.pair_dim[on_floor] == 1, 1, 2 * (model.pair_dim[on_floor] - 1))
    pairs, floor = int(np.sum(~on_floor)), int(np.sum(on_floor))
    hulls = max(arenas * CONTACTS_PER_ROBOT * robots, min(arenas, FEW_ARENAS) * pairs)
    return {
        "naconmax": hulls + arenas * floor,
        "njmax": min(pairs, sim_discs.ROWS_PER_ROBOT * robots) + int(np.sum(rows)),
    }


def _quiet_warp() -> None:
    """Stops Warp from printing its banner and the name of every kernel it loads."""
    import warp

    warp.config.log_level = warp.LOG_ERROR


def build_kernels(physics: Physics, states: PhysicsState) -> None:
    """Makes Warp build MJX's kernels, which it does at their first step: half a minute, once.

    Args:
      physics: the compiled side, `impl` warp, no discs: their kernel is built as they are traced.
      states: [A] arenas; as many as the program will step, since contacts are sized for them.
    """

    def step_once(state: PhysicsState) -> Array:
        return _mjx().step(physics.model, unpack(physics, state)).qpos

    jax.block_until_ready(jax.jit(jax.vmap(step_once))(states))


def rest(physics: Physics, pose: Array) -> PhysicsState:
    """Returns robots at rest at poses [R, 3], x (m), y (m), yaw (rad)."""
    still = jnp.zeros(physics.host.nv)
    return PhysicsState(physics.body.qpos(pose, jnp), still, still)


def unpack(physics: Physics, state: PhysicsState) -> Data:
    """Fills the data of one arena in, to carry through a rollout."""
    return physics.template.replace(**state._asdict())


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
        if physics.discs is not None:
            return sim_discs.step(physics.discs, model, driven, side, obstacle)
        return _mjx().step(model, driven)

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
    `discs` are told side and obstacles themselves.

    Args:
      physics: the compiled side.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      Fields of the model, and of the data.
    """
    if physics.discs is not None:
        return {}, {}
    model, made = physics.model, physics.template
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
    model, rows_of = physics.model, physics.ids.robots
    changes = physics.body.changes(chassis, rows_of, physics.robot, physics.host)
    if physics.discs is not None:  # which read but a few
        changes = {name: changes[name] for name in changes if hasattr(model, name)}
    for name, (rows, values) in changes.items():
        now = jnp.asarray(fields.get(name, getattr(model, name)))
        fields = fields | {name: now.at[rows].set(values)}
    return model.replace(**fields)
