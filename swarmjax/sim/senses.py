"""Finds what surrounds each robot: what its sensors see, and the gaps from its hull to objects."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.sim import dispatch, infrared, neighbours
from swarmjax.sim import gaps as sim_gaps
from swarmjax.sim.infrared import Mount, Reflectance


class Scene(NamedTuple):
    """An arena and the robots in it.

    Attributes:
      pose: [R, 3] x (m), y (m), yaw (rad); absent robots are parked far away from each other.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m); absent obstacles are parked far
        away.
      turn: [R, K] angle by which each sensor is turned to the left of its nominal yaw, rad; None if
        all are 0.
      shades: reflectances of surfaces; None if all are 1.
    """

    pose: Array
    side: Array
    obstacle: Array
    turn: Any = None
    shades: Reflectance | None = None


class Surround(NamedTuple):
    """What surrounds each robot.

    Attributes:
      ray: [R, K] ray lengths, m; see `infrared.distances`.
      bright: [R, K] reflectances of what the rays meet; None if all are 1.
      gap: [R, 3] gaps from the hull to the nearest object of each kind, m; exact up to the sensors'
        range, see `gaps.gaps`.
      complete: [] bool; False if some robots near another may have been left out.
    """

    ray: Array
    bright: Array | None
    gap: Array
    complete: Array


def look(scene: Scene, poses: Any, hull_radius: float, limit: float, impl: str = "jax") -> Surround:
    """Finds what surrounds each robot.

    Args:
      scene: an arena.
      poses: x (m), y (m) and yaw (rad) of each sensor in the frame of the robot.
      hull_radius: m.
      limit: range of a sensor from its own origin, m.
      impl: `jax` or `warp`.

    Returns:
      What surrounds each robot.
    """
    fast = dispatch.load_fast("senses_warp", impl)
    if fast is not None:
        found = fast.look(scene, poses, hull_radius, limit)
        ray, bright = (jnp.swapaxes(found[: len(poses), :, i], 0, 1) for i in range(2))
        gap, complete = found[len(poses) :, :, 0].T, jnp.asarray(True)
        return Surround(ray, bright if scene.shades else None, gap, complete)
    pose, side, obstacle, turn, shades = scene
    near = neighbours.look(pose, hull_radius, limit, jnp)
    gap = sim_gaps.gaps(pose, side, obstacle, hull_radius, jnp, near)
    arena, mount = (pose, side, obstacle, hull_radius, limit), Mount(poses, turn)
    if shades is None:
        ray, bright = infrared.distances(*arena, jnp, mount, near), None
    else:
        ray, bright = infrared.sights(*arena, shades, mount, near)
    # Several computations use the rays. Without the barrier, XLA on a GPU recomputes the rays for
    # each of them.
    ray, bright = jax.lax.optimization_barrier((ray, bright))
    return Surround(ray, bright, gap, jnp.asarray(True) if near is None else ~near.full)
