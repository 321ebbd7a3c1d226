"""Replaces the physics step of MJX-Warp with a step made for one kind of body. Needs Warp.

MJX calls Warp's `step` by name, and this module replaces that function. The model's `opt.solver`
selects the step. All other values of `opt.solver` select MJX-Warp's own step.
"""

import copy
from dataclasses import replace
from typing import Any

import mujoco
import mujoco.mjx.third_party.mujoco_warp as mjw
from mujoco.mjx.warp import forward

from swarmjax.sim import engine
from swarmjax.sim.engine import Engine
from swarmjax.sim.fast import wheeled_warp

_newton = mjw.step


def load_engine(model: mujoco.MjModel, robots: int, arenas: int) -> Engine:
    """Loads MJX-Warp with the contact solver made for wheeled robots.

    Args:
      model: compiled, one arena.
      robots: R.
      arenas: number of arenas stepped together.

    Returns:
      The engine.
    """
    model = copy.copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # the format that `wheeled_warp` reads
    plain = engine.load_mjx(model, robots, "warp", arenas)
    install()
    chosen = plain.model.tree_replace({"opt.solver": wheeled_warp.NUMBER})
    # The label gives the speed of the whole environment, not of the physics alone.
    label = "MJX with swarmjax's contact solver (3.2 times as fast as sim.solver=mjx on an H200)"
    return replace(plain, label=label, model=chosen)


def install() -> None:
    """Makes MJX take the step that a model's `opt.solver` selects; a second call does nothing."""
    forward.mjwarp.step = step


def step(m: Any, d: Any) -> None:
    """Advances all arenas by one physics step.

    Args:
      m: Warp's model.
      d: Warp's data of all arenas, modified in place.
    """
    (wheeled_warp.step if m.opt.solver == wheeled_warp.NUMBER else _newton)(m, d)
