"""Writes the measured speed-ups and a model's predictions for more devices into docs/scaling.md.

`python -m benchmarks.devices_page [lines=benchmarks/results/devices.jsonl] [docs=docs]` writes the
tables between the page's markers, and the plot `figures/devices.png`. The command uses the newest
line of each comparison of `benchmarks.devices_speed`, and the lines of `benchmarks.all_reduce`.

The model describes an update on N devices with equal shares of the work. The update takes the time
of one device, plus the latency of each sum over devices. The latency within a host is measured. The
latency between hosts grows with the logarithm of the number of hosts. Devices also wait for the
slowest device. If the devices' times are normally distributed, the slowest of N devices is
expected to be `EXPECTED_MAX[N]` standard deviations above the mean. The values for 2 and 8 devices
are from Harter 1961, "Expected values of normal order statistics", table 1. The values for 64 and
512 devices are simulated.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil, log2
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks import key_value, pages
from swarmjax import command
from swarmjax.config import ConfigError, Section, about

Line = dict[str, Any]
PAGE, FIGURE = "scaling.md", "figures/devices.png"
EXPECTED_MAX = {1: 0.0, 2: 0.564, 8: 1.424, 64: 2.34, 512: 3.05}
# Sums per update: one for each of 8 minibatches, and 5 for advantages, observations and tallies, as
# in the compiled program (tests/training/test_mesh.py). Each line also states how many sums its
# program has.
REDUCES = 13
_HOST = 8  # devices per host
_HOP_US = 15.0  # time that each doubling of hosts adds to a sum; assumed, not measured
_ROLLOUT = 32  # control steps per update, the default
_MESSAGE = 65_536  # bytes; the networks' 40 kB, rounded up to a size that was timed


@dataclass(frozen=True, kw_only=True)
class PageConfig(Section):
    """Settings: the file of the results, and the folder of the page."""

    lines: str = field(
        default="benchmarks/results/devices.jsonl", metadata=about("file of JSON lines")
    )
    docs: str = field(default="docs", metadata=about(f"folder of {PAGE}"))


def update_ms(line: Line, devices: int) -> float:
    """Returns the milliseconds per update, on one device or on all devices of a line."""
    one = devices == 1
    steps = line["arenas"] if one else line["arenas_in_all"]
    speed = line["arena_steps_per_s_of_one"] if one else line["arena_steps_per_s"]
    return 1e3 * steps * _ROLLOUT / speed


def sum_us(devices: int, measured_us: float) -> float:
    """Predicts the microseconds of a sum over devices.

    Args:
      devices: number of devices, 8 per host.
      measured_us: measured time for two devices of one host.
    """
    return measured_us + _HOP_US * log2(ceil(devices / _HOST))


def predict(one_ms: float, devices: int, measured_us: float, deviation_ms: float) -> float:
    """Predicts the weak-scaling efficiency of N devices, 0..1.

    Args:
      one_ms: time of an update on one device.
      devices: N, a key of `EXPECTED_MAX`.
      measured_us: time of a sum over two devices of one host.
      deviation_ms: standard deviation of the update times of devices.
    """
    if devices == 1:
        return 1.0
    waiting = EXPECTED_MAX[devices] * deviation_ms
    return one_ms / (one_ms + REDUCES * sum_us(devices, measured_us) * 1e-3 + waiting)


def deviation_ms(line: Line, measured_us: float) -> float:
    """Estimates the standard deviation of the devices' update times.

    An update takes longer on two devices than on one. The extra time that the sums over devices do
    not explain is attributed to waiting for the slower device. The estimate is 0 if the extra time
    is shorter than the time of the sums.

    Args:
      line: line of a weak comparison of two devices.
      measured_us: time of a sum.
    """
    lost = update_ms(line, 2) - update_ms(line, 1) - line["sums"] * measured_us * 1e-3
    return max(0.0, lost) / EXPECTED_MAX[2]


def newest(lines: Sequence[Line]) -> list[Line]:
    """Takes the newest line of each comparison.

    Args:
      lines: lines of any benchmarks, the newest last.

    Returns:
      Lines of `devices_speed`, in the order in which their comparisons first appear.
    """
    keys = ("robot", "scaling", "processes", "arenas", "arenas_in_all")
    mine = [line for line in lines if line["benchmark"] == "devices_speed"]
    return list({tuple(line[key] for key in keys): line for line in mine}.values())


def measured_table(lines: Sequence[Line]) -> str:
    """Makes the table of the measurements."""
    rows = [
        "| robots | scaling | processes | arenas, one and two devices | update, ms, one and two "
        "| million arena steps/s, one and two | efficiency |",
        "|---|---|--:|--:|--:|--:|---|",
    ]
    for line in lines:
        middle, low, high = (f"{100 * value:.1f}" for value in line["efficiency"])
        speeds = (line["arena_steps_per_s_of_one"], line["arena_steps_per_s"])
        one, two = (f"{speed / 1e6:.2f}" for speed in speeds)
        times = f"{update_ms(line, 1):.1f}, {update_ms(line, 2):.1f}"
        arenas = f"{line['arenas']:,}, {line['arenas_in_all']:,}"
        rows.append(
            f"| {line['robot']} | {line['scaling']} | {line['processes']} | {arenas} | {times} "
            f"| {one}, {two} | {middle} % [{low}, {high}] |"
        )
    return "\n".join(rows) + "\n"


def model_table(lines: Sequence[Line], measured_us: float) -> str:
    """Makes the table of the model's predictions."""
    rows = ["| robots | arenas a device | 2, measured | 2 | 8 | 64 | 512 |", "|---" * 7 + "|"]
    for line in (line for line in lines if line["scaling"] == "weak"):
        found = _predictions(line, measured_us)
        cells = " | ".join(f"{100 * found[n]:.0f} %" for n in (2, 8, 64, 512))
        label = line["robot"] + (", two processes" if line["processes"] == 2 else "")
        measured = f"{100 * line['efficiency'][0]:.0f} %"
        rows.append(f"| {label} | {line['arenas']:,} | {measured} | {cells} |")
    return "\n".join(rows) + "\n"


def _predictions(line: Line, measured_us: float) -> dict[int, float]:
    spread, one = deviation_ms(line, measured_us), update_ms(line, 1)
    return {n: predict(one, n, measured_us, spread) for n in EXPECTED_MAX}


def draw(lines: Sequence[Line], measured_us: float) -> Figure:
    """Draws the measured efficiency and the curves of the model."""
    plot = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = plot.subplots()
    axes.grid(visible=True, alpha=0.3)
    for number, line in enumerate(line for line in lines if line["scaling"] == "weak"):
        found, colour = _predictions(line, measured_us), f"C{number}"
        several = ", two processes" if line["processes"] == 2 else ""
        label = f"{line['robot']}, {line['arenas']:,} arenas a device{several}"
        axes.plot([*found], [100 * y for y in found.values()], "--", color=colour, label=label)
        middle, low, high = (100 * value for value in line["efficiency"])
        bars = [[middle - low], [high - middle]]
        axes.errorbar([2], [middle], bars, fmt="o", color=colour, capsize=3)
    axes.set_xscale("log", base=2)
    axes.set_xlabel("devices (dots: measured; dashes: model)")
    axes.set_ylabel("weak efficiency, %")
    axes.set_ylim(70, 108)
    axes.legend(fontsize=8)
    return plot


def write(lines: Sequence[Line], docs: Path) -> None:
    """Writes the tables and the plot.

    Raises:
      ConfigError: if the page or a line that it needs is missing.
    """
    found = newest(lines)
    sums = {line["bytes"]: line["microseconds"] for line in lines if "microseconds" in line}
    page = docs / PAGE
    if not found or _MESSAGE not in sums or not page.exists():
        raise ConfigError(
            f"lines must have results of devices_speed and of all_reduce with {_MESSAGE} bytes, "
            f"and docs must have {PAGE}: give other lines or docs."
        )
    text = pages.insert(page.read_text(), PAGE, "measured", measured_table(found))
    text = pages.insert(text, PAGE, "model", model_table(found, sums[_MESSAGE]))
    page.write_text(text)
    plot = draw(found, sums[_MESSAGE])
    # Leaves out Matplotlib's version, so that the same plot gives the same file.
    plot.savefig(docs / FIGURE, dpi=90, metadata={"Software": None})


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given = key_value.load(PageConfig, arguments)
    try:
        lines = [json.loads(line) for line in Path(given.lines).read_text().splitlines()]
    except (OSError, ValueError) as error:
        raise ConfigError(f"lines is {given.lines}, which cannot be read: {error}.") from None
    write(lines, Path(given.docs))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("devices_page", main, PageConfig))
