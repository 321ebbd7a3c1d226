"""Measures the robot in motion: speeds, turns, starts and pushes."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from benchmarks import fidelity_rig as rig
from benchmarks.fidelity_rig import (
    ARGOS,
    BODY,
    CLOSED,
    ENKI,
    FIRMWARE,
    GUIDE,
    LIBRARY,
    PROTO,
    RIGID,
    ROS,
    TOFFI,
    XPUCK,
    Rig,
    Row,
    Track,
    beside,
    contact_radius,
)
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.sim import motor
from swarmjax.sim.wheeled import encoders
from swarmjax.task.stage_files import load_levels

FULL = 0.25, 0.0  # m/s, rad/s: more than the motors can reach
TURN = 0.0, 3.14
SPIN = 0.0, 100.0
LAG = 0.05  # s
# Time from rest to full speed, s. The first value is v / (mu g). In the second value a skid without
# friction carries the load that the start shifts back, so the wheels push with
# mu m g / (1 + mu h / x). The mass is at h = 0.0153 m, and the skid is at x = 0.025 m.
RAMPS = 0.1256 / 9.81, 0.1256 / 9.81 * (1 + 0.0153125 / 0.025)
SPIN_UP = 3.14 * 1.0564e-4 / (0.16 * 9.81 * 0.026)  # s; time to a turn rate: w I / (mu m g L / 2)
FINE = 0.0005  # s; a physics step that resolves a start of 8 to 21 ms
REVOLUTIONS = 10
TRACKS = 0.052, 0.057  # m
# Command v, w (m/s, rad/s), then the resulting motion (m/s, rad/s). The wheels have a radius of
# 0.02 m and a limit of 6.28 rad/s, and are 0.052 m apart. Their speeds are
# left = (v - 0.026 w) / 0.02 and right = (v + 0.026 w) / 0.02, both clipped to the limit.
COMMANDS = (
    ((0.0, 3.14), (0.0, 3.14)),
    ((0.0625, 3.14), (0.05323, 2.78346)),
    ((0.125, 0.0), (0.125, 0.0)),
    ((0.125, 1.57), (0.10489, 0.79654)),
    ((0.125, 3.14), (0.08448, 1.58154)),
    ((0.1875, 3.14), (0.11573, 0.37962)),
    ((0.1875, 1.57), (0.1256, 0.0)),
    ((0.25, 3.14), (0.1256, 0.0)),
)
_SAMPLES = 100_000
_speed, _starting, _pushing, _firm = (
    partial(beside, section) for section in ("Speed", "Starting", "Against a wall", "Firmware")
)


def rows(planar: Rig, wheeled: Rig, planar_v2: Rig, wheeled_v2: Rig) -> list[Row]:
    """Measures all rows."""
    both = planar, wheeled
    return [
        *_speeds(both, (planar_v2, wheeled_v2)),
        *_turns(both, (planar_v2, wheeled_v2)),
        *_commands(both),
        *_track(both),
        *_starts(both),
        *_first_steps(both),
        *_wall(both),
        *_encoders(wheeled),
        *_quantised(),
        *_speed_noise(),
    ]


# Limits and commands


def wheel_speed(bench: Rig) -> float:
    """Measures the speed of the left wheel at full speed ahead, rad/s."""
    data = rig.place(bench)
    return float(rig.run(bench, data, rig.command(bench, *FULL), 20).qvel[-1, 6])


def turning_ends(bench: Rig) -> float:
    """Finds by bisection the commanded speed (m/s) above which a turn of 3.14 rad/s is lost."""
    low, high = 0.1, 0.3
    while high - low > 1e-5:
        middle = 0.5 * (low + high)
        _, turn = rig.steady(bench, middle, TURN[1], steps=5)
        low, high = (middle, high) if turn > 1e-3 else (low, middle)
    return high


def rolling_radius(bench: Rig) -> float:
    """Measures the distance that the robot drives per commanded radian of its wheels, m."""
    wheels = rig.command(bench, 0.1, 0.0)
    return rig.steady(bench, 0.1, 0.0)[0] / float(wheels[0])


def _speeds(first: Sequence[Rig], second: Sequence[Rig]) -> list[Row]:
    top, top_v2 = ([rig.steady(each, *FULL)[0] for each in both] for both in (first, second))
    wheels = [wheel_speed(both[1]) for both in (first, second)]
    radius = [rolling_radius(each) for each in first]
    limits = {PROTO: 6.28, f"{FIRMWARE}, 1100 steps/s": 6.91}
    tops = {PROTO: 0.1256, ENKI: 0.128, XPUCK: 0.13, f"{FIRMWARE}, 1100 steps/s": 0.138}
    # The old guide and the paper give the same top speed. The motors that the guide describes
    # cannot reach this speed.
    tops[f"{GUIDE}, of old"] = 0.25
    ways = {PROTO: 0.020, "e-puck.gctronic.com": 0.02037, ARGOS: 0.02067}
    return [
        *_speed("wheel speed limit, version 1", "rad/s", limits, (None, wheels[0])),
        *_speed("wheel speed limit, version 2", "rad/s", {PROTO: 7.536}, (None, wheels[1])),
        *_speed("top speed, version 1", "m/s", tops, top),
        *_speed("top speed, version 2", "m/s", {PROTO: 0.15072, GUIDE: 0.15}, top_v2),
        *_speed("way per radian of the wheels", "m", ways, radius),
    ]


def _turns(first: Sequence[Rig], second: Sequence[Rig]) -> list[Row]:
    spin, spin_v2 = ([rig.steady(each, *SPIN)[1] for each in both] for both in (first, second))
    far = [rig.load(replace(each.robot, effective_track=0.0569)) for each in first]
    limit, unit, wide = "in-place turn limit", "rad/s", [rig.steady(each, *SPIN)[1] for each in far]
    ends = "commanded speed above which no turn is left"
    # The limit is twice the speed of the wheels' rims, divided by the track.
    closed, closed_v2, closed_wide = (
        {CLOSED: 2 * speed * 0.020 / track}
        for speed, track in ((6.28, 0.052), (7.536, 0.052), (6.28, 0.0569))
    )
    return [
        *_speed(f"{limit}, version 1", unit, closed, spin),
        *_speed(f"{limit}, version 2", unit, closed_v2, spin_v2),
        *_speed(f"{limit}, effective track of 0.0569 m", unit, closed_wide, wide),
        *_speed(ends, "m/s", {CLOSED: 0.1256 + 3.14 * 0.026}, map(turning_ends, first)),
    ]


def _commands(both: Sequence[Rig]) -> list[Row]:
    found = []
    for (speed, turn), theirs in COMMANDS:
        ours = zip(*(rig.steady(each, speed, turn) for each in both), strict=True)
        axes = zip((("v", "m/s"), ("w", "rad/s")), theirs, ours, strict=True)
        for (axis, unit), number, pair in axes:
            quantity = f"{axis} of command {speed:g} m/s, {turn:g} rad/s"
            found += beside("Commands", quantity, unit, {CLOSED: number}, pair)
    return found


# Turning


def turned(bench: Rig, track: float) -> tuple[float, float, float]:
    """Turns a robot on the spot for ten commanded revolutions.

    Args:
      bench: the rig.
      track: effective track, m.

    Returns:
      Ratio of realised to commanded turn; the effective track that follows from this ratio, m;
      drift of the robot's middle, m.
    """
    bench = rig.load(replace(bench.robot, effective_track=track))
    asked = rig.command(bench, *TURN)
    rate = 2.0 * asked[1] * bench.robot.wheel_radius / bench.robot.track
    steps = round(REVOLUTIONS * 2.0 * math.pi / (rate * bench.control_step))
    pose = rig.run(bench, rig.place(bench), asked, steps).pose
    share = float(pose[-1, 2] / (rate * steps * bench.control_step))
    return share, bench.robot.track / share, float(np.hypot(*pose[-1, :2]))


def _track(both: Sequence[Rig]) -> list[Row]:
    sources = {PROTO: 0.052}, {"webots_ros2": 0.05694, "epuck-pathfinding": 0.057, ROS: 0.05685}
    found = []
    for track, effective in zip(TRACKS, sources, strict=True):
        share, realised, drift = zip(*(turned(each, track) for each in both), strict=True)
        which, row = f"set to {track:g} m", partial(beside, "Turning")
        found += [
            *row(
                f"share realised of ten revolutions, {which}", "1", {CLOSED: 0.052 / track}, share
            ),
            *row(f"effective track by ten revolutions, {which}", "m", effective, realised),
            *row(f"drift over ten revolutions, {which}", "m", {CLOSED: 0.0}, drift),
        ]
    return found


# Starting and stopping


def start(bench: Rig, command: tuple[float, float], yaw: float = 0.0) -> Track:
    """Runs a robot from rest at a constant command, for 400 steps of the rig."""
    return rig.run(bench, rig.place(bench, yaw=yaw), rig.command(bench, *command), 400)


def reach_time(bench: Rig, command: tuple[float, float], yaw: float = 0.0) -> float:
    """Returns the time from rest to 0.99 of the steady speed or turn rate, divided by 0.99, s.

    With constant acceleration this is the time to the full steady speed.
    """
    track = start(bench, command, yaw)
    moved = np.hypot(*track.pose[:, :2].T) if command[0] else track.pose[:, 2]
    rate = np.diff(moved) / bench.control_step
    share = np.concatenate([[0.0], rate / rate[-1]])
    after = int(np.argmax(share >= 0.99))
    within = (0.99 - share[after - 1]) / (share[after] - share[after - 1])
    return (after - 1 + within) * bench.control_step / 0.99


def first_step(bench: Rig, command: tuple[float, float], axis: int) -> float:
    """Returns the speed in the first control step, as a share of the steady speed.

    Axis 0 gives the forward speed, and axis 2 gives the turn rate.
    """
    pose = rig.run(bench, rig.place(bench), rig.command(bench, *command), 20).pose[:, axis]
    return float((pose[1] - pose[0]) / (pose[-1] - pose[-2]))


def lagged(bench: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Returns time (s) and share of the commanded speed [10] for a motor with a lag.

    The robot starts from rest. The values hold after each of the first ten control steps.
    """
    bench = rig.load(replace(bench.robot, motor_lag=LAG))
    data, wheels = rig.place(bench), rig.command(bench, 0.05, 0.0)
    share = rig.run(bench, data, wheels, 10).qvel[1:, 0] / 0.05
    return bench.control_step * np.arange(1, 11), share


def lag_error(bench: Rig) -> float:
    """Returns the largest difference between a lagging motor's share and 1 - exp(-t / lag)."""
    time, share = lagged(bench)
    return float(np.abs(share + np.expm1(-time / LAG)).max())


def pitch(track: Track) -> np.ndarray:
    """Returns the pitch [T + 1] of a wheeled robot, degrees; positive with the nose down."""
    w, x, y, z = track.qpos[:, 3:7].T
    return np.degrees(np.arcsin(2.0 * (w * y - z * x)))


def pitch_play(bench: Rig) -> float:
    """Returns the pitch at which a pushed robot rests, degrees: the mean of front and back."""
    angles = []
    for torque in (0.001, -0.001):  # N m; 0.04 N on a skid
        data = rig.place(bench)
        data.body(BODY).xfrc_applied[4] = torque
        angles.append(pitch(rig.run(bench, data, np.zeros(2), 60))[-1])
    return 0.5 * (angles[0] - angles[1])


def start_hop(bench: Rig) -> tuple[float, float]:
    """Returns the largest lift (m) and pitch (degrees) in a start at full speed, at any step."""
    bench = rig.load(bench.robot, bench.model.opt.timestep)
    track = rig.run(bench, rig.place(bench), rig.command(bench, *FULL), 40)
    height = track.qpos[:, 2]
    return float(height.max() - height[0]), float(np.abs(pitch(track)).max())


def _starts(both: Sequence[Rig]) -> list[Row]:
    fine = [rig.load(each.robot, FINE) for each in both]
    ahead, turn = ([reach_time(each, way) for each in fine] for way in (FULL, TURN))
    askew = [reach_time(each, FULL, yaw=0.25 * math.pi) for each in fine]
    low, high = RAMPS
    return [
        *_starting("to full speed, wheels carry all", "s", {CLOSED: low}, (ahead[0], None)),
        *_starting("to full speed, a skid takes its share", "s", {CLOSED: high}, (None, ahead[1])),
        *_starting("to full speed at a heading of 45°", "s", {CLOSED: low}, (askew[0], None)),
        *_starting("to full speed at a heading of 45°", "s", {CLOSED: high}, (None, askew[1])),
        *_starting("to a turn of 3.14 rad/s", "s", {CLOSED: SPIN_UP}, turn),
    ]


def _first_steps(both: Sequence[Rig]) -> list[Row]:
    ahead, turn = ([first_step(each, *way) for each in both] for way in ((FULL, 0), (TURN, 2)))
    # The mean speed in a control step that begins with constant acceleration, as a share of the
    # full speed.
    low, high, spin = ({CLOSED: 1 - 0.5 * time / 0.032} for time in (*RAMPS, SPIN_UP))
    way, touch = "first control step, share of full speed", "pitch before a skid touches"
    lag, (lift, tilt) = "motor with a lag of 50 ms, largest deviation", start_hop(both[1])
    return [
        *_starting(f"{way}, wheels carry all", "1", low, (ahead[0], None)),
        *_starting(f"{way}, a skid takes its share", "1", high, (None, ahead[1])),
        *_starting("first control step, share of a turn of 3.14 rad/s", "1", spin, turn),
        *_starting(lag, "1", {CLOSED: 0.0}, map(lag_error, both)),
        *_starting("hop of a start at full speed", "m", {RIGID: 0.0}, (None, lift)),
        *_starting("pitch of a start at full speed", "°", {PROTO: 0.23}, (None, tilt)),
        *_starting(f"{touch}, pushed over", "°", {PROTO: 0.23}, (None, pitch_play(both[1]))),
    ]


# Against a wall


def blocked(bench: Rig) -> Track:
    """Drives from 2 cm away into a wall for 4 s at full speed; samples each physics step."""
    bench = rig.load(bench.robot, bench.model.opt.timestep)
    data = rig.place(bench, x=0.5 * rig.SIDE - contact_radius(bench) - 0.02)
    return rig.run(bench, data, rig.command(bench, *FULL), round(4.0 / bench.control_step))


def _wall(both: Sequence[Rig]) -> list[Row]:
    tracks, late = [blocked(each) for each in both], slice(-60, None)  # last samples of the push
    depth = [each.pose[:, 0] + contact_radius(both[0]) - 0.5 * rig.SIDE for each in tracks]
    deepest, mean = [d.max() for d in depth], [d[late].mean() for d in depth]
    push, slips = [each.force[late].mean() for each in tracks], tracks[1].qvel[late, 6].mean()
    hop = tracks[1].qpos[:, 2].max() - tracks[1].qpos[0, 2]
    tilt = np.abs(pitch(tracks[1])).max()
    # The push is mu m g, or mu m g / (1 + mu h / x) if a skid takes its share. The wall touches the
    # robot at h = 0.015 m, and the skid is at x = 0.025 m.
    grip = {CLOSED: 0.16 * 9.81}
    shared = {CLOSED: 0.16 * 9.81 / (1 + 0.015 / 0.025)}
    return [
        *_pushing("deepest", "m", {RIGID: 0.0}, deepest),
        *_pushing("mean depth while it pushes", "m", {RIGID: 0.0}, mean),
        *_pushing("mean push, wheels carry all", "N", grip, (push[0], None)),
        *_pushing("mean push, a skid takes its share", "N", shared, (None, push[1])),
        *_pushing("mean speed of the slipping wheels", "rad/s", {PROTO: 6.28}, (None, slips)),
        *_pushing("hop of the slipping robot, largest", "m", {RIGID: 0.0}, (None, hop)),
        *_pushing("pitch of the slipping robot, largest", "°", {PROTO: 0.23}, (None, tilt)),
    ]


# Encoders and firmware


def _encoders(bench: Rig) -> list[Row]:
    track = rig.run(bench, rig.place(bench), rig.command(bench, 0.002, 0.0), 300)
    angle = encoders(track.qpos, np)[:, 0, 0]
    ticks, behind = np.diff(angle), track.qpos[:, 7] - angle
    step = ticks[ticks > 1e-6].min()
    return [
        *beside("Encoders", "resolution", "rad", {PROTO: 0.00628}, (None, step)),
        *beside(
            "Encoders", "least lag behind the wheel", "rad", {CLOSED: 0.0}, (None, behind.min())
        ),
        *beside(
            "Encoders", "largest lag behind it", "rad", {CLOSED: 0.00628}, (None, behind.max())
        ),
    ]


def made(version: Literal["epuck1", "epuck2"], steps: float) -> float:
    """Returns the steps per second that the firmware makes for a requested number."""
    turn = 2.0 * math.pi / motor.STEPS_PER_TURN
    # Adds a millionth of a step: without it, a rounding error could make the firmware truncate a
    # whole number to the next lower one.
    return float(motor.quantise(np.float64((steps + 1e-6) * turn), version, np) / turn)


def _quantised() -> list[Row]:
    speeds = ((950, 1000.0), (900, 10000 / 11), (800, 10000 / 12), (600, 625.0))
    found = []
    for asked, theirs in speeds:
        quantity = f"speed made of {asked} steps/s, version 1"
        found += _firm(quantity, "steps/s", {LIBRARY: theirs}, [made("epuck1", asked)] * 2)
    first, second = (
        max(made(version, asked) / asked - 1.0 for asked in range(1, 1001))
        for version in ("epuck1", "epuck2")
    )
    largest = "largest excess up to 1000 steps/s"
    return [
        *found,
        *_firm(f"{largest}, version 1", "1", {LIBRARY: 0.1}, [first] * 2),
        *_firm(f"{largest}, version 2", "1", {FIRMWARE: 0.02}, [second] * 2),
    ]


def _speed_noise() -> list[Row]:
    realism = load_levels(EvaluateConfig, ["policy=none", "realism=real"]).realism
    realism = replace(realism, speed_quantisation=None)
    ones = np.ones((_SAMPLES // 2, 2), np.float32)
    noisy = motor.disturb(ones, realism, np.uint32(0), np.int32(0), np).astype(float)
    return [
        *_firm("wheel speed noise, mean", "1", {TOFFI: 1.0}, [noisy.mean()] * 2),
        *_firm("wheel speed noise, sd", "1", {TOFFI: 0.05}, [noisy.std()] * 2),
    ]
