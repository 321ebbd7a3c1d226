"""The e-puck in numbers: unit and source beside each.

Frame: x forward, y left, z up, origin on the floor midway between the wheels; angles
counter-clockwise from +x, in radians. Numbers are restated from the sources named; the
Webots model itself is not part of this project.
"""

import math

HULL_RADIUS = 0.037  # m; Webots E-puck, collision cylinder
HULL_BOTTOM = 0.0025  # m; lower end of the same cylinder (centre 0.025, height 0.045)
HULL_TOP = 0.0475  # m; its upper end
MASS = 0.16  # kg; Webots e-puck guide, version 1: body 0.15 and two wheels of 0.005
# kg m^2; body 9.78585e-5 about its vertical axis, two 5 g wheels 0.026 m off the axis
# (2 * 0.005 * 0.026**2 = 6.8e-6) and their own 5.1e-7 each: 1.06e-4 in all.
YAW_INERTIA = 1.06e-4
WHEEL_RADIUS = 0.020  # m; Webots E-puck
TRACK = 0.052  # m; distance between the wheels, Webots E-puck and its guide
MAX_WHEEL_SPEED = 6.28  # rad/s; Webots E-puck version 1 (1000 steps/s)
FRICTION = 1.0  # wheel on floor; Webots ContactProperties.coulombFriction default
GRAVITY = 9.81  # m/s^2; Webots WorldInfo default

MAX_SPEED = MAX_WHEEL_SPEED * WHEEL_RADIUS  # m/s; 0.1256, both wheels at their limit
MAX_TURN_RATE = 3.14  # rad/s; section 4 of the paper

SENSORS = 8
SENSOR_RANGE = 0.04  # m; section 4 of the paper, and the e-puck guide
SENSOR_HEIGHT = 0.033  # m; Webots E-puck
# x (m), y (m), yaw (rad) of ps0..ps7 in the robot's frame: Webots E-puck, yaws worked out from
# its axis-angle rotations. Numbered clockwise from front-right. Every origin lies 3.5 to 6 mm
# inside the hull.
SENSOR_POSES = (
    (0.030, -0.010, -0.30081),
    (0.022, -0.025, -0.80081),
    (0.000, -0.031, -math.pi / 2),
    (-0.030, -0.015, -2.64398),
    (-0.030, 0.015, 2.63920),
    (0.000, 0.031, math.pi / 2),
    (0.022, 0.025, 0.79920),
    (0.030, 0.010, 0.29920),
)
