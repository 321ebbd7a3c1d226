"""Draws the plots of docs/robot.md."""

import math
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import figure
from matplotlib.axes import Axes

from benchmarks import fidelity_infrared, fidelity_motion, rig
from benchmarks.rig import Rig
from swarmjax import epuck

mpl.use("Agg")
THEIRS, PLANAR, WHEELED, OURS = "0.35", "tab:blue", "tab:orange", "tab:blue"
_SIZE, _DOTS = (8.0, 3.4), 90  # inches; dots per inch


def draw(folder: Path, planar: Rig, wheeled: Rig) -> None:
    """Draws all plots.

    Args:
      folder: folder for the PNG files.
      planar: rig of the planar body.
      wheeled: rig of the wheeled body.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plots = {
        "infrared_curves": _curves(),
        "infrared_fit": _fit(),
        "commands": _commands(planar, wheeled),
        "starts": _starts(planar, wheeled),
    }
    for name, plot in plots.items():
        # Leaves out Matplotlib's version, so that the same plot gives the same file.
        plot.savefig(folder / f"{name}.png", dpi=_DOTS, metadata={"Software": None})


def _figure(columns: int, rows: int = 1, height: float = 1.0) -> tuple[figure.Figure, list[Axes]]:
    plot = figure.Figure(figsize=(_SIZE[0], _SIZE[1] * height), layout="constrained")
    axes = plot.subplots(rows, columns, squeeze=False)
    for each in axes.flat:
        each.grid(visible=True, alpha=0.3)
    return plot, list(axes.flat)


def _curves() -> figure.Figure:
    """Draws infrared counts over distance, for four simulators, a real robot and our responses."""
    plot, (left, right) = _figure(2)
    distance = np.linspace(0.0, 0.08, 400)
    ours = fidelity_infrared.counts("webots", distance * math.cos(epuck.SENSOR_TILT))
    left.plot(1e3 * distance, ours, color=OURS, label="ours, webots")
    table = np.array(fidelity_infrared.CURVES, float)
    for column, marker in zip(range(1, 5), "os^d", strict=True):
        name = fidelity_infrared.SIMULATORS[column - 1]
        label = f"{name}, 0 beyond" if (table[:, column] == 0.0).any() else name
        left.plot(table[:, 0], table[:, column], marker, color=THEIRS, mfc="none", label=label)
    left.set(xlabel="length of the ray (mm)", ylabel="counts", title="simulators")
    for sensor in fidelity_infrared.at_gap(distance).T:
        right.plot(1e3 * distance, sensor, color=OURS, alpha=0.5, lw=0.8)
    right.plot([], [], color=OURS, label="ours, real: eight sensors")
    webots = fidelity_infrared.at_gap(distance, "webots").mean(axis=-1) - fidelity_infrared.FREE
    right.plot(1e3 * distance, webots, "--", color=OURS, label="ours, webots: mean of eight")
    gap, mean = np.array(fidelity_infrared.NET, float).T
    mean = mean + fidelity_infrared.at_gap(np.array(0.07)).mean()
    right.plot(10 * gap, mean, "o", color=THEIRS, mfc="none", label="measured, mean of eight")
    right.set(xlabel="gap to the hull (mm)", title="one real e-puck, above free space")
    for each in (left, right):
        each.set(yscale="log", ylim=(10, 5000))
        each.legend(fontsize=8)
    return plot


def _fit() -> figure.Figure:
    """Draws the measured table and the fitted curve above free space, one panel per sensor."""
    plot, axes = _figure(4, 2, height=1.3)
    gap = np.linspace(0.008, 0.075, 200)
    fitted = fidelity_infrared.at_gap(gap)
    for i, panel in enumerate(axes):
        panel.plot(1e2 * gap, fitted[:, i], color=OURS)
        at = 1e2 * np.array(epuck.MEASURED_GAPS[1:])
        mean = np.array(epuck.MEASURED_INFRARED[i][1:]) - epuck.INFRARED_FIT[i][2]
        sd = epuck.MEASURED_INFRARED_SD[i][1:]
        panel.errorbar(at, mean, sd, fmt="o", ms=3, color=THEIRS, capsize=2)
        panel.set(yscale="log", ylim=(10, 3000))
        panel.set_title(f"ps{i}", fontsize=9)
        panel.tick_params(labelsize=8)
        panel.label_outer()
    plot.supxlabel("gap to the hull (cm)", fontsize=10)
    plot.supylabel("counts above free space; dots: measured ± sd", fontsize=10)
    return plot


def _commands(planar: Rig, wheeled: Rig) -> figure.Figure:
    """Draws realised speeds beside commands, and the turn in ten commanded revolutions."""
    plot, (left, right) = _figure(2)
    for (speed, turn), theirs in fidelity_motion.COMMANDS:
        left.annotate("", theirs, (speed, turn), arrowprops={"arrowstyle": "->", "alpha": 0.3})
    asked = [command for command, _ in fidelity_motion.COMMANDS]
    left.plot(*zip(*asked, strict=True), "o", color=THEIRS, mfc="none", label="commanded")
    for bench, marker, colour, name in _bodies(planar, wheeled):
        made = [rig.steady(bench, *command) for command in asked]
        left.plot(*zip(*made, strict=True), marker, color=colour, ms=7, label=name)
    left.set(xlabel="speed (m/s)", ylabel="turn rate (rad/s)", title="commanded and realised")
    for bench, marker, colour, name in _bodies(planar, wheeled):
        for track in fidelity_motion.TRACKS:
            turn = _turn(bench, track)
            label = name if track == fidelity_motion.TRACKS[0] else None
            right.plot(turn[0][::60], turn[1][::60], marker, color=colour, label=label)
    revolutions = np.array([0.0, fidelity_motion.REVOLUTIONS])
    for track in fidelity_motion.TRACKS:
        text = f"closed form, {track:g} m"
        right.plot(revolutions, revolutions * 0.052 / track, color=THEIRS, lw=0.8, label=text)
    right.set(xlabel="commanded revolutions", ylabel="realised", title="effective track")
    for each in (left, right):
        each.legend(fontsize=8)
    return plot


def _bodies(planar: Rig, wheeled: Rig) -> list[tuple[Rig, str, str, str]]:
    """Returns each rig with its marker, colour and name."""
    return [(planar, "x", PLANAR, "planar"), (wheeled, "+", WHEELED, "wheeled")]


def _turn(bench: Rig, track: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the commanded and realised revolutions [T] of a robot that turns on the spot."""
    bench = rig.load(replace(bench.robot, effective_track=track))
    wheels = rig.command(bench, *fidelity_motion.TURN)
    pose = rig.run(bench, rig.place(bench), wheels, 625).pose
    rate = fidelity_motion.TURN[1] / (2.0 * math.pi)
    return rate * bench.control_step * np.arange(len(pose)), pose[:, 2] / (2.0 * math.pi)


def _starts(planar: Rig, wheeled: Rig) -> figure.Figure:
    """Draws the distance that a robot loses at a start, and the speed of a motor with a lag."""
    plot, (left, right) = _figure(2)
    time, full = np.linspace(0.0, 0.128, 500), 0.1256
    for ramp, style in zip(fidelity_motion.RAMPS, ("-", "--"), strict=True):
        way = np.where(time < ramp, 0.5 * time**2 / ramp, time - 0.5 * ramp)
        label = "even ramp" if style == "-" else "even ramp, a skid carries"
        left.plot(1e3 * time, 1e3 * full * (time - way), style, color=THEIRS, label=label)
    for bench, marker, colour, name in _bodies(planar, wheeled):
        fine = rig.load(bench.robot, bench.model.opt.timestep)
        steps = round(0.128 / fine.control_step)
        x = rig.run(fine, rig.place(fine), rig.command(fine, *fidelity_motion.FULL), steps).pose[
            :, 0
        ]
        at = fine.control_step * np.arange(steps + 1)
        left.plot(1e3 * at, 1e3 * (full * at - x), f"{marker}:", color=colour, label=name)
    left.set(xlabel="time (ms)", ylabel="way lost (mm)", title="start at full speed, from rest")
    time = np.linspace(0.0, 0.32, 200)
    right.plot(
        1e3 * time, -np.expm1(-time / fidelity_motion.LAG), color=THEIRS, label="closed form"
    )
    for bench, marker, colour, name in _bodies(planar, wheeled):
        at, share = fidelity_motion.lagged(bench)
        right.plot(1e3 * at, share, marker, color=colour, label=name)
    right.set(xlabel="time (ms)", ylabel="share of the speed", title="motor with a lag of 50 ms")
    for each in (left, right):
        each.legend(fontsize=8)
    return plot
