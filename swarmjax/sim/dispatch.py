"""Chooses the faster code of `sim/fast/` where it exists, and plain code elsewhere.

The other modules of this package use plain MJX and plain loops.
"""

import importlib
import importlib.util
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from swarmjax.config import ConfigError

# Evaluations also use `pieces` and must run without JAX and MJX.
if TYPE_CHECKING:
    import mujoco

    from swarmjax.sim.config import RobotConfig, SimConfig
    from swarmjax.sim.engine import Engine
    from swarmjax.sim.model import Ids

Array = Any
# Limits of iterations and line-search steps. With `jax`, the limits in `_NEWTON_STEPS` stop MJX's
# Newton method once its result is close enough. In contacts of planar robots, its result differed
# from converged MuJoCo C by at most 6.4e-6 m with 3 iterations of 5 steps, and by up to 2.9e-4 m
# with 2 iterations of 4 steps. All other limits are high enough for solvers to converge.
_NEWTON_STEPS = {"planar": (3, 5), "wheeled": (30, 20)}
_MOST_STEPS = (100, 50)  # MuJoCo's own limits
# Limit of sweeps for discs. The tightest jam of tests/sim/test_solver.py takes 150 to 200 sweeps.
# The error in that jam was 1.9e-4 with 100 sweeps, 4e-6 with 200 sweeps, and 2.4e-5 with MJX's own
# step. On an H200, a limit of 200 sweeps costs 1.5 % of training time.
_MOST_SWEEPS = 200
# Forces settle more slowly between hulls with friction. A jam with friction 1.5 takes 400 sweeps to
# get as close to MuJoCo C as a jam without friction. With `jax`, hulls with friction get the same
# limits of MJX's Newton method as the wheeled body.
_MOST_RUBBING_SWEEPS = 400
# Largest number of wheeled robots that the solver made for wheels handles. Each robot looks through
# all rows of its arena, which takes too long in larger swarms.
MOST_WHEELED = 64
MOST_PIECES = 16  # most objects that `pieces` splits; each piece makes the program longer
MOST_COMPARED = 100  # up to this number of robots, all pairs are compared
_UNROLLED = 8  # objects per iteration of an unrolled loop; 4 and 16 were no faster


def resolve_impl(impl: str) -> str:
    """Resolves `auto` to `warp` on an NVIDIA GPU with Warp installed, and to `jax` elsewhere.

    Args:
      impl: `auto`, `jax` or `warp`.

    Returns:
      `jax` or `warp`.

    Raises:
      ConfigError: Warp is selected but not installed.
    """
    installed = importlib.util.find_spec("warp") is not None
    if impl == "warp" and not installed:
        raise ConfigError(
            "sim.impl is warp, but Warp is not installed: add the extra gpu, or give sim.impl=jax."
        )
    if impl != "auto":
        return impl
    import jax

    return "warp" if installed and jax.default_backend() == "gpu" else "jax"


def resolve_solver(solver: str, impl: str, body: str, robots: int, *, rubs: bool = False) -> str:
    """Resolves `auto` to `swarm` where available, and to `mjx` elsewhere.

    Tests require that `swarm`, wherever it is chosen, matches MuJoCo C at least as closely as MJX's
    own step does (tests/sim/test_solver.py).

    Args:
      solver: `auto`, `mjx` or `swarm`.
      impl: `jax` or `warp`.
      body: `planar` or `wheeled`.
      robots: number of robots to compile for.
      rubs: whether hulls have friction.

    Returns:
      `mjx` or `swarm`.

    Raises:
      ConfigError: `swarm` is selected but not available for this combination.
    """
    available = body == "planar" or (impl == "warp" and robots <= MOST_WHEELED and not rubs)
    if solver == "swarm" and not available:
        raise ConfigError(
            f"sim.solver is swarm, but robot.body is {body}: give sim.solver=mjx or auto, or give "
            f"sim.impl=warp with at most {MOST_WHEELED} robots and without robot.hull_friction."
        )
    if solver != "auto":
        return solver
    return "swarm" if available else "mjx"


class EngineChoice(NamedTuple):
    """The engine to use, with `auto` and null resolved.

    Attributes:
      impl: `jax` or `warp`.
      solver: `mjx` or `swarm`.
      iterations: limit of solver iterations.
      ls_iterations: limit of line-search steps.
    """

    impl: str
    solver: str
    iterations: int
    ls_iterations: int


def choose(sim: "SimConfig", robot: "RobotConfig") -> EngineChoice:
    """Resolves the simulation settings for a robot.

    Args:
      sim: the settings.
      robot: the robot that the model is compiled for.

    Returns:
      The resolved settings for this device.

    Raises:
      ConfigError: Warp is selected but not installed, or a solver is not available.
    """
    impl, body = resolve_impl(sim.impl), robot.body
    rubs = robot.hull_friction > 0.0
    solver = resolve_solver(sim.solver, impl, body, sim.robots, rubs=rubs)
    iterations, ls_iterations = _MOST_STEPS
    if (solver, body) == ("swarm", "planar"):
        iterations = _MOST_RUBBING_SWEEPS if rubs else _MOST_SWEEPS
    elif (solver, impl) == ("mjx", "jax"):
        iterations, ls_iterations = _NEWTON_STEPS["wheeled" if rubs else body]
    return EngineChoice(impl, solver, iterations, ls_iterations)


def load_engine(
    model: "mujoco.MjModel", ids: "Ids", robot: "RobotConfig", choice: EngineChoice, arenas: int
) -> "Engine":
    """Loads the engine for physics steps.

    Args:
      model: compiled model of one arena; provides the solver's iterations.
      ids: rows of the moving bodies.
      robot: settings of the robot.
      choice: result of `choose`.
      arenas: number of arenas stepped together.

    Returns:
      The engine: with `mjx`, MJX's own; with `swarm`, the one made for the robot's body.
    """
    from swarmjax.sim import engine

    robots = len(ids.hull_body)
    if choice.impl == "warp":
        engine.start_warp()
    if choice.solver == "mjx":
        return engine.load_mjx(model, robots, choice.impl, arenas)
    if robot.body == "planar":
        from swarmjax.sim.fast import discs

        solve = _push_apart(choice.impl, rubs=discs.rubs(model))
        found = discs.load_engine(model, ids, robot.hull_radius, solve)
    else:
        from swarmjax.sim.fast import wheeled_warp  # needs Warp

        found = wheeled_warp.load_engine(model, robots, arenas)
    return replace(found, impl=choice.impl, solver=choice.solver)


def _push_apart(impl: str, *, rubs: bool) -> Any:
    """Returns the contact solver for discs. With `warp`, Warp must be installed."""
    name = f"{'rubbing' if rubs else 'planar'}_{impl}"
    return importlib.import_module(f"swarmjax.sim.fast.{name}").push_apart


def load_fast(name: str, impl: str) -> ModuleType | None:
    """Loads a module of Warp kernels; returns None where plain JAX is used instead.

    Args:
      name: `arenas_warp`, `paths_warp` or `senses_warp`.
      impl: `jax` or `warp`.

    Returns:
      The module of `swarmjax.sim.fast`, or None.
    """
    return None if impl != "warp" else importlib.import_module(f"swarmjax.sim.fast.{name}")


def has_cells(robots: int, listed: int) -> bool:
    """Returns whether robots look for others in grid cells; otherwise all pairs are compared.

    Args:
      robots: number of robots.
      listed: how many robots each robot would be compared with if cells were used.
    """
    return robots > max(MOST_COMPARED, listed)


def pieces(count: int, xp: Any) -> list[slice]:
    """Splits an axis of objects into slices, so that XLA makes one kernel of the computation.

    On a GPU, a minimum over an axis of four obstacles becomes its own kernel, which reads its
    inputs from memory. If obstacles are processed one by one, all operations are elementwise, and
    XLA keeps the values in registers.

    Args:
      count: number of objects.
      xp: `numpy` or `jax.numpy`.

    Returns:
      Slices that cover the axis, one per object. If there are no objects or more than
      `MOST_PIECES`, or with NumPy, where every call costs time, there is a single slice.
    """
    if xp is np or not 0 < count <= MOST_PIECES:
        return [slice(None)]
    return [slice(i, i + 1) for i in range(count)]


def least(values: Iterable[Array], limit: float, xp: Any) -> Array:
    """Returns the minimum over all objects, given their values in pieces.

    Args:
      values: [..., N] values of objects, one array per piece.
      limit: upper limit of the result.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] the minimum, or `limit` if that is smaller.
    """
    found = limit
    for value in values:
        found = xp.minimum(found, xp.min(value, axis=-1, initial=limit))
    return found


def in_turn[T](step: Callable[[T, Any], T], first: T, things: Any) -> T:
    """Folds a step over many objects, one by one, in JAX.

    On a CPU, XLA computes a minimum over the last axis without vector instructions. If objects are
    processed one by one, all operations are elementwise, and XLA uses vector instructions. For the
    rays of 1,024 robots and 256 boxes, this was nine times as fast.

    Args:
      step: takes the result so far and one object; returns the new result.
      first: the result if there are no objects.
      things: arrays [N, ...] of the objects.

    Returns:
      The result for all objects.
    """
    import jax

    folded = jax.lax.scan(
        lambda found, one: (step(found, one), None), first, things, unroll=_UNROLLED
    )
    return folded[0]
