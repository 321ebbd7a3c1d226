"""How MJX-Warp takes a physics step: by Newton's method, its own, or by one made for a body.

MJX calls Warp's `step` by its name, and there it is replaced; a model says by its `opt.solver`
which step is meant, and one that names none of ours is stepped as ever. Needs Warp.
"""

from typing import Any

import mujoco.mjx.third_party.mujoco_warp as mjw
from mujoco.mjx.warp import forward

from swarmjax.sim.fast import wheeled_warp

_newton = mjw.step


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
