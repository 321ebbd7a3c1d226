"""Adds geoms that can touch only if an explicit contact pair names them."""

from collections.abc import Sequence

import mujoco

from swarmjax import epuck

HULL_GROUP = 3  # contact spheres, which rays ignore
FLOOR_GROUP = 4  # wheels, skids and floor, which rays ignore; wheels reach beyond the hull
# A hull makes contact as a sphere at the height of the robot's centre of mass, and all other faces
# are upright. In the plane, the sphere acts exactly like a disc of the hull's radius. A sphere
# needs one contact point per pair, while a capsule needs two. A push neither tips the robot nor
# puts extra load on a skid.
CONTACT_HEIGHT = epuck.COM_HEIGHT
SPIN = 5e-3, 1e-4, 1e-4  # MuJoCo's default torsional and rolling friction, unused with condim 3


def add_geom(
    body: mujoco.MjsBody,
    name: str,
    kind: mujoco.mjtGeom,
    size: Sequence[float],
    place: Sequence[float],
    group: int = 0,
) -> str:
    """Adds a massless geom and returns its name.

    Args:
      body: parent body.
      name: name of the geom.
      kind: shape.
      size: three numbers, m, with MuJoCo's meaning for the shape.
      place: position in the frame of the body, m.
      group: the geom group, by which rays choose what they see.

    Returns:
      `name`.
    """
    body.add_geom(
        name=name, type=kind, size=size, pos=place, contype=0, conaffinity=0, mass=0.0, group=group
    )
    return name


def add_hull(body: mujoco.MjsBody, name: str, radius: float) -> str:
    """Adds the hull geom that makes contact, and returns the geom's name.

    Args:
      body: body of the robot, with its origin on the floor.
      name: name of the robot.
      radius: m.

    Returns:
      The name of the geom.
    """
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    place = [0.0, 0.0, CONTACT_HEIGHT]
    return add_geom(body, f"{name}_hull", sphere, [radius, 0, 0], place, HULL_GROUP)


def add_ray_hull(body: mujoco.MjsBody, name: str, radius: float) -> None:
    """Adds the hull that rays see: a cylinder.

    Args:
      body: body of the robot, with its origin on the floor.
      name: name of the robot.
      radius: m.
    """
    half = 0.5 * (epuck.HULL_TOP - epuck.HULL_BOTTOM)
    middle = 0.5 * (epuck.HULL_TOP + epuck.HULL_BOTTOM)
    cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
    add_geom(body, f"{name}_body", cylinder, [radius, half, 0], [0.0, 0.0, middle])
