"""Numbers of the e-puck, each with its unit and source.

The frame has x forward, y left and z up. The frame's origin is on the floor midway between the
wheels. Angles are in radians, counter-clockwise from +x. The numbers are restated from the named
sources; the Webots model itself is not part of this project.
"""

import math

HULL_RADIUS = 0.037  # m; Webots E-puck, collision cylinder
HULL_BOTTOM = 0.0025  # m; lower end of the same cylinder (centre 0.025, height 0.045)
HULL_TOP = 0.0475  # m; upper end of the same cylinder
MASS = 0.16  # kg; Webots e-puck guide, version 1: body 0.15 and two wheels of 0.005
# kg m^2; the body has 9.78585e-5 about its vertical axis. Two wheels of 5 g, 0.026 m off the axis,
# add 2 * 0.005 * 0.026**2 = 6.8e-6. Each wheel also adds 5.1e-7 about its own axis. The total is
# 1.06e-4.
YAW_INERTIA = 1.06e-4
WHEEL_MASS = 0.005  # kg, each; Webots E-puck
# The whole body without its wheels, for `robot=wheeled`: Webots E-puck, version 1. The moments are
# in the order of the older model file, in which y is up. The newer file, in which z is up, has them
# in the same order.
BODY_INERTIA = (8.64333e-5, 8.74869e-5, 9.78585e-5)  # kg m^2 about x, y, z of the centre of mass
COM_HEIGHT = 0.015  # m; height of the centre of mass, exactly over the axle
SKID_X = 0.025  # m; x of the front end of the box on which the robot skids; its back end is at -x
SKID_CLEARANCE = 0.0001  # m; from the floor to the lower face of that box
AXLE_Y = 0.026  # m; distance of the centre of each wheel from the middle of the robot
WHEEL_INERTIA = (5.1e-7, 1.0e-6, 5.1e-7)  # kg m^2; cylinder of 5 g, radius 0.02, width 0.005 m
ENCODER_STEP = 0.00628  # rad; Webots E-puck, 2 pi / 1000
WHEEL_RADIUS = 0.020  # m; Webots E-puck
TRACK = 0.052  # m; distance between the wheels, Webots E-puck and its guide
MAX_WHEEL_SPEED = 6.28  # rad/s; Webots E-puck version 1 (1000 steps/s)
FRICTION = 1.0  # wheel on floor; Webots ContactProperties.coulombFriction default
GRAVITY = 9.81  # m/s^2; Webots WorldInfo default

MAX_SPEED = MAX_WHEEL_SPEED * WHEEL_RADIUS  # m/s; 0.1256, with both wheels at their limit
MAX_TURN_RATE = 3.14  # rad/s; section 4 of the paper

SENSORS = 8
SENSOR_RANGE = 0.04  # m; section 4 of the paper, and the e-puck guide
SENSOR_HEIGHT = 0.033  # m; Webots E-puck
# x (m), y (m), yaw (rad) of ps0..ps7 in the robot's frame: Webots E-puck, with yaws computed from
# its axis-angle rotations. The sensors are numbered clockwise from front-right. Every origin lies
# 3.5 to 6 mm inside the hull.
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
SENSOR_TILT = 0.16  # rad; upward tilt of every ray, Webots E-puckDistanceSensor
# Ray length (m), counts, and standard deviation relative to the counts: Webots
# E-puckDistanceSensor. Webots interpolates linearly and holds the end values beyond the table. The
# points up to 0.05 m are also in INFRARED_TABLE of cyberbotics/epuck_ros2 (driver.cpp, Apache-2.0).
INFRARED_TABLE = (
    (0.000, 4095.00, 0.00200),
    (0.005, 2133.33, 0.00300),
    (0.010, 1465.73, 0.00700),
    (0.015, 601.46, 0.04060),
    (0.020, 383.84, 0.01472),
    (0.030, 234.93, 0.02410),
    (0.040, 158.03, 0.02870),
    (0.050, 120.00, 0.04225),
    (0.060, 104.09, 0.03065),
    (0.070, 67.19, 0.04897),
)
# Counts of ps0..ps7 of one e-puck, from which no offset is subtracted, with an object at 0, 1, .. 7
# cm from the robot's hull.
# Source: sensorMean.txt and sensorVar.txt of mohammad7t/Particle-Filter-for-e-puck-on-Webots,
# commit 0de64e89; sensorVar.txt holds standard deviations. We infer that the robot was a real one,
# since each sensor has its own offset.
MEASURED_GAPS = (0.00, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07)  # m
MEASURED_INFRARED = (
    (3779.0, 1382.69, 760.04, 588.15, 519.47, 501.50, 487.47, 482.03),
    (3810.0, 1544.69, 582.97, 354.89, 279.66, 248.75, 228.76, 217.64),
    (3773.0, 1018.55, 496.80, 351.08, 300.80, 287.06, 278.81, 275.53),
    (3780.0, 1060.76, 487.94, 333.14, 282.18, 260.95, 248.44, 241.00),
    (3807.0, 1461.56, 862.05, 687.04, 616.59, 592.02, 578.29, 571.09),
    (3794.0, 1191.99, 605.62, 445.14, 373.41, 349.61, 339.56, 330.56),
    (3843.0, 1396.62, 578.83, 373.52, 301.30, 267.49, 248.63, 235.69),
    (3811.0, 1467.29, 831.16, 651.16, 575.72, 545.98, 527.31, 514.18),
)
MEASURED_INFRARED_SD = (
    (2.88, 11.11, 12.58, 12.42, 12.06, 12.50, 11.15, 11.00),
    (1.51, 18.36, 4.42, 3.58, 4.23, 2.25, 2.21, 2.26),
    (0.85, 4.98, 4.14, 3.93, 3.66, 3.11, 2.64, 3.40),
    (0.97, 5.34, 4.27, 3.85, 3.34, 2.94, 3.25, 2.86),
    (0.87, 2.59, 3.46, 3.26, 3.35, 3.17, 3.55, 2.36),
    (1.31, 3.20, 3.90, 4.01, 4.37, 4.16, 2.63, 2.51),
    (0.92, 3.07, 3.37, 4.20, 3.30, 2.68, 2.21, 1.79),
    (1.59, 4.42, 4.96, 6.21, 5.45, 4.67, 3.89, 7.91),
)
# The curve A / (gap + d)^2 + b of ps0..ps7: A (counts m^2), d (m), b (counts). The curve was fitted
# to the means at 1 to 7 cm by least squares, weighted by the standard deviations. No residual may
# exceed 13 counts. This limit affects only ps0, which has a residual of 13.1 counts without the
# limit. The fourth column is the median of the standard deviations at 1 to 7 cm (counts). The last
# column is the mean at 0 cm, which is the largest reading (counts). tests/sim/test_response.py
# repeats the fit.
INFRARED_FIT = (
    (0.16935, 0.0034172, 442.63, 12.06, 3779.0),
    (0.18230, 0.0015093, 179.89, 3.58, 3810.0),
    (0.12368, 0.0026275, 244.33, 3.66, 3773.0),
    (0.13991, 0.0028235, 211.09, 3.34, 3780.0),
    (0.19082, 0.0043124, 530.57, 3.26, 3807.0),
    (0.17608, 0.0040069, 294.90, 3.90, 3794.0),
    (0.19573, 0.0027767, 197.87, 3.07, 3843.0),
    (0.22013, 0.0048760, 472.78, 4.96, 3811.0),
)
