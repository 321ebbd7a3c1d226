"""Engines that step the physics of one arena; this file holds MJX's own step, unpatched."""

import contextlib
import io
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jax import Array

# Warp stores the pairs of geoms that may touch, for all arenas together. It compares spheres around
# geoms, and the sphere around a wall contains all robots. So for each robot, Warp gets memory for
# pairs with all walls and boxes, and with this number of other robots on average. On average, a
# robot of a swarm has far fewer others near it.
OTHERS_PER_ROBOT = 3
# Largest number of contacts per robot in one arena. A disc touches at most six discs of its own
# size at once.
ROWS_PER_ROBOT = 6
_STARTING = threading.Lock()  # `train` starts Warp in a thread; two starts would create Warp twice
FEW_ARENAS = 64  # in so few arenas, every pair of geoms gets memory

# Model and data of MJX (in either implementation), or of a faster engine that uses the same field
# names.
Model = Any
Data = Any


@dataclass(frozen=True, eq=False)
class Engine:
    """Engine for the physics steps of a program.

    Attributes:
      label: description of the engine.
      model: model of one arena, on the device.
      template: data of one arena, whose fields are replaced by those of a real state.
      step: takes the model, the data, the arena's side [] (m) and the obstacles [M, 5], and returns
        the data one physics step later.
      is_mjx: whether MJX takes the steps. The engine's model and data then hold obstacles and
        walls. Any other engine gets obstacles and walls as arguments, and its model has only the
        fields that the engine reads.
      impl: `jax` or `warp`.
      solver: `mjx` or `swarm`.
    """

    label: str
    model: Model
    template: Data
    step: Callable[[Model, Data, Array, Array], Data]
    is_mjx: bool = True
    impl: str = "jax"
    solver: str = "mjx"

    @property
    def builds_kernels(self) -> bool:
        """Whether Warp builds MJX's kernels at the first step, which takes half a minute."""
        return self.is_mjx and self.impl == "warp"


def load_mjx(model: mujoco.MjModel, robots: int, impl: str, arenas: int) -> Engine:
    """Puts a model on the device for unpatched MJX.

    Args:
      model: compiled, one arena.
      robots: R.
      impl: `jax` or `warp`.
      arenas: number of arenas stepped together; these arenas share Warp's contact memory.

    Returns:
      MJX's engine.
    """
    limits = _limits(model, robots, arenas) if impl == "warp" else {}
    mjx = import_mjx()
    template = mjx.make_data(model, impl=impl, **limits)
    device_model = mjx.put_model(model, impl=impl)
    return Engine("MJX's own step", device_model, template, step_mjx, impl=impl)


def step_mjx(model: Model, data: Data, _side: Array, _obstacle: Array) -> Data:
    """Takes one physics step with `mjx.step`, which finds obstacles and walls in model and data."""
    return import_mjx().step(model, data)


def import_mjx() -> Any:
    """Imports MJX when it is first used; the import takes two to four seconds.

    Planar robots do not need MJX.
    """
    with contextlib.redirect_stdout(io.StringIO()):  # MJX prints two lines if Warp is missing
        from mujoco import mjx
    return mjx


def start_warp() -> None:
    """Starts Warp without its banner and without the name of every kernel that it loads."""
    import warp

    with _STARTING:
        warp.config.log_level = warp.LOG_ERROR
        warp.init()


def _limits(model: mujoco.MjModel, robots: int, arenas: int) -> dict[str, int]:
    """Returns Warp's memory: contacts in all arenas together, and solver rows in each arena."""
    on_floor = model.geom_type[model.pair_geom1] == mujoco.mjtGeom.mjGEOM_PLANE
    rows = _rows(model)
    of_world = (model.geom_bodyid[[model.pair_geom1, model.pair_geom2]] == 0).any(axis=0)
    pairs, floor = int(np.sum(~on_floor)), int(np.sum(on_floor))
    met = min(pairs, int(np.sum(of_world & ~on_floor)) + OTHERS_PER_ROBOT * robots)
    hulls = max(arenas * met, min(arenas, FEW_ARENAS) * pairs)
    return {
        "naconmax": hulls + arenas * floor,
        "njmax": min(pairs, ROWS_PER_ROBOT * robots) * int(np.max(rows[~on_floor], initial=1))
        + int(np.sum(rows[on_floor])),
    }


def _rows(model: mujoco.MjModel) -> np.ndarray:
    """Returns for each pair of geoms how many solver rows its contact takes, [P]."""
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        return model.pair_dim
    return np.where(model.pair_dim == 1, 1, 2 * (model.pair_dim - 1))
