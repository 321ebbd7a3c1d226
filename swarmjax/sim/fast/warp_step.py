"""How MJX-Warp takes a physics step: by Newton's method, its own, or by one made for a body.

MJX calls Warp's `step` by its name, and there it is replaced; a model says by its `opt.solver`
which step is meant, and one that names none of ours is stepped as ever. Needs Warp.
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
    """Loads MJX-Warp with the contact solver that is made for wheeled robots.

    Args:
      model: compiled, one arena.
      robots: R.
      arenas: how many arenas will be stepped together.

    Returns:
      The engine.
    """
    model = copy.copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # as `wheeled_warp` reads it
    plain = engine.load_mjx(model, robots, "warp", arenas)
    install()
    chosen = plain.model.tree_replace({"opt.solver": wheeled_warp.NUMBER})
    # Speeds of the environment: README.md, "What steps the robots".
    label = "MJX with swarmjax's contact solver (3.2 times as fast as sim.solver=mjx on an H200)"
    return replace(plain, label=label, model=chosen)


def install() -> None:
    """Lets MJX step models as their `opt.solver` says; does nothing the second time."""
    forward.mjwarp.step = step


def step(m: Any, d: Any) -> None:
    """Moves all arenas on by one physics step.

    Args:
      m: Warp's model.
      d: Warp's data of all arenas, written to.
    """
    (wheeled_warp.step if m.opt.solver == wheeled_warp.NUMBER else _newton)(m, d)
