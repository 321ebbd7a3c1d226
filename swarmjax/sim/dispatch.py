"""Chooses the faster ways of `sim/fast/`, and the plain ones where there are none.

Everything else in this room is plain MJX and plain loops, and works without `fast/`, slower.
"""

import importlib
import importlib.util
from collections.abc import Iterable
from dataclasses import replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from swarmjax.config import ConfigError

# What judges policies goes through short axes too, and does without JAX and MJX.
if TYPE_CHECKING:
    import mujoco

    from swarmjax.sim.config import RobotConfig, SimConfig
    from swarmjax.sim.engine import Engine
    from swarmjax.sim.model import Ids

Array = Any
# Iterations and line-search steps at most; see docs/design-notes.md for what was measured. MJX's
# Newton method by `jax` is cut off where it is near enough; all else has room to converge.
_NEWTON_STEPS = {"planar": (3, 5), "wheeled": (30, 20)}
_MOST_STEPS = (100, 50)  # MuJoCo's own
# Of discs: the tightest jam of tests/sim/test_solver.py takes 150 to 200. With 100 it was 1.9e-4
# off where MJX's own step is 2.4e-5 off, with 200 it is 4e-6 off; on an H200 they cost 1.5 % of
# training.
_MOST_SWEEPS = 200
# Where hulls rub, forces come to rest more slowly: a jam of friction 1.5 takes 400 sweeps to be
# as near as one without friction, and MJX's Newton method by `jax` as many steps as wheels do.
_MOST_RUBBING_SWEEPS = 400
# In a jam of more wheeled robots the solver made for them leaves up to 7 mm/s (design note 38).
MOST_WHEELED = 5


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
    import jax

    return "warp" if installed and jax.default_backend() == "gpu" else "jax"


def resolve_solver(solver: str, impl: str, body: str, robots: int, *, rubs: bool = False) -> str:
    """Turns `auto` into `swarm` where that can be, `mjx` elsewhere.

    The tests hold `swarm` to MuJoCo C at least as closely as MJX's own step, wherever this chooses
    it (tests/sim/test_solver.py).

    Args:
      solver: `auto`, `mjx` or `swarm`.
      impl: `jax` or `warp`.
      body: `planar` or `wheeled`.
      robots: that are compiled in.
      rubs: whether hulls have friction.

    Returns:
      `mjx` or `swarm`.

    Raises:
      ConfigError: if `swarm` is asked for where it cannot be.
    """
    if solver == "swarm" and body == "wheeled" and impl != "warp":
        raise ConfigError(
            f"sim.solver is swarm, but robot.body is wheeled and sim.impl is {impl}: give mjx "
            "or auto, or sim.impl=warp."
        )
    if solver == "swarm" and body == "wheeled" and robots > MOST_WHEELED:
        raise ConfigError(
            f"sim.solver is swarm, but robot.body is wheeled and sim.max_robots is {robots}: give "
            f"mjx or auto, or {MOST_WHEELED} robots at most."
        )
    if solver == "swarm" and body == "wheeled" and rubs:
        raise ConfigError(
            "sim.solver is swarm, but robot.body is wheeled and its hulls have friction "
            "(robot.hull_friction or realism.hull_friction): give mjx or auto, or no such friction."
        )
    if solver == "swarm" and _discs() is None:
        raise ConfigError(
            "sim.solver is swarm, but swarmjax.sim.fast cannot be imported: give mjx or auto."
        )
    if solver != "auto":
        return solver
    possible = body == "planar" or (impl == "warp" and robots <= MOST_WHEELED and not rubs)
    return "swarm" if possible and _discs() is not None else "mjx"


class EngineChoice(NamedTuple):
    """How the physics is stepped: all that `auto` and null stand for is filled in.

    Attributes:
      impl: `jax` or `warp`.
      solver: `mjx` or `swarm`.
      iterations: of the solver, at most.
      ls_iterations: steps of its line search, at most.
    """

    impl: str
    solver: str
    iterations: int
    ls_iterations: int


def choose(sim: "SimConfig", robot: "RobotConfig") -> EngineChoice:
    """Resolves the settings of the simulation for a robot.

    Args:
      sim: the settings.
      robot: that the model is compiled for.

    Returns:
      What they come to on this device.

    Raises:
      ConfigError: if Warp is asked for and not installed, or a solver where it cannot be.
    """
    impl, body = resolve_impl(sim.impl), robot.body
    rubs = robot.hull_friction > 0.0
    solver = resolve_solver(sim.solver, impl, body, sim.robots, rubs=rubs)
    iterations, ls_iterations = _MOST_STEPS
    if (solver, body) == ("swarm", "planar"):
        iterations = _MOST_RUBBING_SWEEPS if rubs else _MOST_SWEEPS
    elif (solver, impl) == ("mjx", "jax"):
        iterations, ls_iterations = _NEWTON_STEPS["wheeled" if rubs else body]
    return EngineChoice(
        impl, solver, sim.iterations or iterations, sim.ls_iterations or ls_iterations
    )


def load_engine(
    model: "mujoco.MjModel", ids: "Ids", robot: "RobotConfig", choice: EngineChoice, arenas: int
) -> "Engine":
    """Loads what takes the physics steps.

    Args:
      model: compiled, one arena; solver iterations are taken from here.
      ids: rows of the moving bodies.
      robot: the robot's numbers.
      choice: as `choose` made it.
      arenas: how many arenas will be stepped together.

    Returns:
      MJX's engine for `mjx`, the one made for the robot's body for `swarm`.
    """
    from swarmjax.sim import engine

    robots = len(ids.hull_body)
    if choice.impl == "warp":
        engine.quiet_warp()
    if choice.solver == "mjx":
        return engine.load_mjx(model, robots, choice.impl, arenas)
    if robot.body == "planar":
        from swarmjax.sim.fast import discs

        solve = _push_apart(choice.impl, rubs=discs.rubs(model))
        found = discs.load_engine(model, ids, robot.hull_radius, solve)
    else:
        from swarmjax.sim.fast import warp_step  # needs Warp

        found = warp_step.load_engine(model, robots, arenas)
    return replace(found, impl=choice.impl, solver=choice.solver)


def _push_apart(impl: str, *, rubs: bool) -> Any:
    """What solves for the contacts of discs; those by Warp need it to be installed."""
    name = f"{'rubbing' if rubs else 'planar'}_{impl}"
    return importlib.import_module(f"swarmjax.sim.fast.{name}").push_apart


def load_paths(impl: str) -> ModuleType | None:
    """Loads what finds shortest paths by Warp; None where plain JAX does.

    Args:
      impl: `jax` or `warp`.

    Returns:
      `swarmjax.sim.fast.paths_warp`, or None.
    """
    if impl != "warp" or _discs() is None:
        return None
    return importlib.import_module("swarmjax.sim.fast.paths_warp")


def pieces(count: int, xp: Any) -> list[slice]:
    """Cuts an axis of things up as is fastest to go through.

    Args:
      count: how many things there are.
      xp: `numpy` or `jax.numpy`.

    Returns:
      Slices that cover the axis; one of all things where `fast/unroll.py` is not there.
    """
    try:
        from swarmjax.sim.fast import unroll
    except ImportError:
        return [slice(None)]
    return unroll.pieces(count, xp)


def least(values: Iterable[Array], limit: float, xp: Any) -> Array:
    """Least of what there is of all things.

    Args:
      values: [..., N] of things, one array a piece.
      limit: where there is nothing less.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] at most `limit`.
    """
    found = limit
    for value in values:
        found = xp.minimum(found, xp.min(value, axis=-1, initial=limit))
    return found


def _discs() -> ModuleType | None:
    """The engine of planar robots, or None without `fast/`."""
    try:
        from swarmjax.sim.fast import discs
    except ImportError:
        return None
    return discs
