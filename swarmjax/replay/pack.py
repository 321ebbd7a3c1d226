"""Packs recordings into few bytes: numbers are rounded to quanta, and differences are deflated.

The packed data are one zlib stream with three parts. First comes the length of the header (4 bytes,
little-endian), then the header (JSON), and last the series of all runs, in the order in which the
header lists them.

A series is a table of integers with one row per frame. Each number is stored as the difference to
the number above it; the first row is stored as it is. Signed differences are folded: 0, -1, 1, -2,
2, ... become 0, 1, 2, 3, 4, ... The numbers are stored column by column: first the lowest byte of
every number, then the next byte of every number, and so on. All numbers of a series have as many
bytes as the largest one needs. `templates/replay.js` reads this format.
"""

import colorsys
import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from swarmjax.replay.record import Recording, ReplayEpisode

# Quanta of positions (m), headings (rad), and the sum of each reward term since the start. The
# stored numbers are off by at most half a quantum.
FINE = {"length": 2e-4, "angle": 1e-3, "reward": 1e-4}
# Swarms of more robots have quanta that are `COARSER` times as large, so that a page stays small.
MANY = 100
COARSER = 5
RAY = 5e-4  # quantum of ray lengths, m; a ray is shown with the middle of its interval
MEASURE = 1e-3  # quantum of a goal's own measures
# Colours for small swarms, distinct on light and dark pages.
_PALETTE = (
    "#2f7fd1", "#e06c00", "#1f9d6b", "#c94f9d", "#c9a100",
    "#35a7c9", "#a0653c", "#8e6bd0", "#7a9a1e", "#d1495b",
)  # fmt: skip
_GOLDEN = 0.381966  # share of a turn between hues; keeps any number of robots distinct


def pack(about: Mapping[str, Any], episodes: Sequence[ReplayEpisode], reach: float) -> bytes:
    """Packs recordings.

    Args:
      about: Further entries of the header.
      episodes: The recordings of each level.
      reach: Length of a ray that meets nothing, m.

    Returns:
      A zlib stream.
    """
    listed, tables = [], []
    quanta = _quanta(max(run.pose.shape[1] for episode in episodes for run in episode.runs))
    for episode in episodes:
        listed.append(_describe(episode) | {"runs": []})
        for recording in episode.runs:
            columns = _columns(recording, reach, quanta)
            packed = {name: fold(table) for name, table in columns.items()}
            tables += [planes for planes, _ in packed.values()]
            listed[-1]["runs"].append(
                _describe_run(recording)
                | {"series": [[name, columns[name].shape[1], packed[name][1]] for name in packed]}
            )
    header = {**about, "quanta": quanta, "dark": dark(reach), "episodes": listed}
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    return zlib.compress(b"".join([len(text).to_bytes(4, "little"), text, *tables]), 9)


def _quanta(robots: int) -> dict[str, float]:
    """Returns the quanta for swarms of at most this many robots, by name."""
    coarser = COARSER if robots > MANY else 1
    return {name: coarser * size for name, size in FINE.items()} | {"ray": RAY, "measure": MEASURE}


def fold(table: np.ndarray) -> tuple[bytes, int]:
    """Packs one series.

    Args:
      table: [N, C] whole numbers of any type; their differences fold to 32 bits.

    Returns:
      The bytes, and the number of bytes per number, 1 to 4.
    """
    steps = np.diff(table.astype(np.int64), axis=0, prepend=0).T.ravel()
    folded = np.where(steps < 0, -2 * steps - 1, 2 * steps).astype("<u4")
    width = max(1, (int(folded.max()).bit_length() + 7) // 8)
    return folded.view(np.uint8).reshape(-1, 4)[:, :width].T.tobytes(), width


def colours(robots: int) -> list[str]:
    """Gives every robot a colour.

    Args:
      robots: Number of robots.

    Returns:
      One colour per robot, as #rrggbb.
    """
    if robots <= len(_PALETTE):
        return list(_PALETTE[:robots])
    rgb = [
        colorsys.hls_to_rgb(i * _GOLDEN % 1.0, (0.5, 0.62, 0.42)[i % 3], 0.62)
        for i in range(robots)
    ]
    return [f"#{''.join(f'{round(255 * part):02x}' for part in each)}" for each in rgb]


def dark(reach: float) -> int:
    """Returns the whole number that stands for a ray that meets nothing.

    Args:
      reach: Length of such a ray, m.

    Returns:
      The number, which is larger than that of any shorter ray.
    """
    return int(np.ceil(reach / RAY))


def _columns(
    recording: Recording, reach: float, quanta: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Returns the series [N, C] of a run by name, as integers. A robot's columns are adjacent."""
    rows, length = len(recording.pose), quanta["length"]
    ray = np.where(recording.ray < reach, np.floor(recording.ray / RAY), dark(reach))
    touch = recording.touching @ np.array([1, 2, 4])
    series = {
        "x": recording.pose[..., 0] / length,
        "y": recording.pose[..., 1] / length,
        "yaw": recording.pose[..., 2] / quanta["angle"],
        "ray": ray,
        "touch": touch,
        "contacts": recording.contacts,
    }
    latched = (recording.arrival > 0) & (np.arange(rows)[:, None] >= recording.arrival)
    if (recording.target != recording.target[0]).any():
        series["target"] = recording.target / length
    if (recording.arrived != latched).any():  # some robot left its target; `arrival` cannot show it
        series["arrived"] = recording.arrived.astype(int)
    if recording.measured.size:
        series["measured"] = recording.measured / MEASURE
    for name, term in recording.reward.items():
        series[f"reward.{name}"] = np.cumsum(term, axis=0) / quanta["reward"]
    return {name: np.rint(each).reshape(rows, -1) for name, each in series.items()}


def _describe(episode: ReplayEpisode) -> dict[str, Any]:
    """Returns the header entry of a level, with lengths in m rounded to 10 um."""
    scene = episode.runs[0].scene
    sensor = scene.sensor
    if (sensor == sensor[:1]).all():
        sensor = sensor[:1]  # all robots have the same nominal mounting
    return {
        "label": episode.label,
        "level": episode.level,
        "side": round(scene.side, 5),
        "target": episode.runs[0].target[0].round(5).tolist(),
        "box": scene.box.round(5).tolist(),
        "sensor": sensor.round(5).tolist(),
        "colours": colours(episode.runs[0].pose.shape[1]),
    }


def _describe_run(recording: Recording) -> dict[str, Any]:
    """Returns the header entry of a run, without its series."""
    return {"frames": len(recording.pose), "arrival": recording.arrival.tolist()}
