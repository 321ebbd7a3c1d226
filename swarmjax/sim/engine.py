"""What takes a physics step of one arena: by default MJX's own step, unpatched."""

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jax import Array

# Warp stores the contacts of all arenas together, those of hulls and what they touch by this
# average a robot, which is far more than a swarm makes. Contacts with the floor are counted apart.
CONTACTS_PER_ROBOT = 3
# Contacts of one arena that there is room for: a disc touches six neighbours of its size at once.
ROWS_PER_ROBOT = 6
FEW_ARENAS = 64  # in so few, all may be crowded at once: there is room for every pair

# Of MJX, by either implementation, or of a faster engine, by the same names.
Model = Any
Data = Any


@dataclass(frozen=True, eq=False)
class Engine:
    """What takes the physics steps of a program.

    Attributes:
      label: what steps the robots, in words.
      model: of one arena, on the device.
      template: data of one arena, to fill in.
      step: model, data, side [] (m) and obstacles [M, 5] to the data a physics step later.
      is_mjx: whether MJX steps: obstacles and walls then lie in its model and data. Any other
        engine is told them, and its model has only the fields that it reads.
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
        """Whether Warp builds MJX's kernels at the first step, which takes half a minute, once."""
        return self.is_mjx and self.impl == "warp"


def load_mjx(model: mujoco.MjModel, robots: int, impl: str, arenas: int) -> Engine:
    """Puts a model on the device, to be stepped by MJX as it comes.

    Args:
      model: compiled, one arena.
      robots: R.
      impl: `jax` or `warp`.
      arenas: how many arenas will be stepped together (Warp shares its contact memory).

    Returns:
      MJX's engine.
    """
    limits = _limits(model, robots, arenas) if impl == "warp" else {}
    mjx = import_mjx()
    template = mjx.make_data(model, impl=impl, **limits)
    device_model = mjx.put_model(model, impl=impl)
    return Engine("MJX's own step", device_model, template, step_mjx, impl=impl)


def step_mjx(model: Model, data: Data, _side: Array, _obstacle: Array) -> Data:
    """Takes one physics step by `mjx.step`; obstacles and walls lie in model and data."""
    return import_mjx().step(model, data)


def import_mjx() -> Any:
    """Imports MJX, which takes two to four seconds, and is not needed where all are discs."""
    with contextlib.redirect_stdout(io.StringIO()):  # it prints twice where Warp is not installed
        from mujoco import mjx
    return mjx


def quiet_warp() -> None:
    """Stops Warp from printing its banner and the name of every kernel it loads."""
    import warp

    warp.config.log_level = warp.LOG_ERROR


def _limits(model: mujoco.MjModel, robots: int, arenas: int) -> dict[str, int]:
    """Room for contacts: of all arenas together, and for the solver's rows of each one."""
    on_floor = model.geom_type[model.pair_geom1] == mujoco.mjtGeom.mjGEOM_PLANE
    rows = _rows(model)
    pairs, floor = int(np.sum(~on_floor)), int(np.sum(on_floor))
    hulls = max(arenas * CONTACTS_PER_ROBOT * robots, min(arenas, FEW_ARENAS) * pairs)
    return {
        "naconmax": hulls + arenas * floor,
        "njmax": min(pairs, ROWS_PER_ROBOT * robots) * int(np.max(rows[~on_floor], initial=1))
        + int(np.sum(rows[on_floor])),
    }


def _rows(model: mujoco.MjModel) -> np.ndarray:
    """Rows of the solver [P] that a contact of each pair takes."""
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        return model.pair_dim
    return np.where(model.pair_dim == 1, 1, 2 * (model.pair_dim - 1))
