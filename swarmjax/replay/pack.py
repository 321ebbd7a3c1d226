"""Recordings as few bytes: whole numbers of a quantum, differences in time, deflated.

What is packed is the length of the header (4 bytes, little-endian), the header (JSON), and one
after the other the series of all runs that the header lists. A series is a table of whole
numbers, a row a frame: of each number the difference to the one above it (of the first row, the
number itself), folded to 0, -1, 1, -2, 2, ... = 0, 1, 2, 3, 4, ..., column by column; first the
lowest byte of all of them, then the next one, as many as are needed. All of it is one zlib
stream. `templates/replay.js` reads it.
"""

import colorsys
import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.replay.record import Recording, ReplayEpisode

LENGTH = 2e-4  # m; poses are at most half of it off
ANGLE = 1e-3  # rad; likewise
RAY = 5e-4  # m; a ray is shown with the middle of its interval
MOST = 1 << 30  # of quanta; differences of such numbers fold to 32 bits
REWARD = 1e-4  # of each term of the reward, summed up since the start
# Of small swarms; told apart on a light and on a dark page.
_PALETTE = (
    "#2f7fd1", "#e06c00", "#1f9d6b", "#c94f9d", "#c9a100",
    "#35a7c9", "#a0653c", "#8e6bd0", "#7a9a1e", "#d1495b",
)  # fmt: skip
_GOLDEN = 0.381966  # of a turn: hues that are this far apart stay apart, however many there are


def pack(about: Mapping[str, Any], episodes: Sequence[ReplayEpisode], reach: float) -> bytes:
    """Packs recordings.

    Args:
        about: Further entries of the header.
        episodes: What became of each level.
        reach: Length that a ray has where there is nothing, m.

    Returns:
        A zlib stream.
    """
    listed, tables = [], []
    for episode in episodes:
        listed.append(_describe(episode) | {"runs": []})
        for recording in episode.runs:
            columns = _columns(recording, reach)
            packed = {name: fold(name, table) for name, table in columns.items()}
            tables += [planes for planes, _ in packed.values()]
            listed[-1]["runs"].append(
                _describe_run(recording)
                | {"series": [[name, columns[name].shape[1], packed[name][1]] for name in packed]}
            )
    quanta = {"length": LENGTH, "angle": ANGLE, "ray": RAY, "reward": REWARD}
    header = {**about, "quanta": quanta, "dark": dark(reach), "episodes": listed}
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    return zlib.compress(b"".join([len(text).to_bytes(4, "little"), text, *tables]), 9)


def fold(name: str, table: np.ndarray) -> tuple[bytes, int]:
    """Packs one series.

    Args:
        name: Of the series.
        table: [N, C] whole numbers of any type, less than `MOST` to either side of 0.

    Returns:
        Its bytes, and how many bytes a number takes, 1 to 4.

    Raises:
        ConfigError: If a number is too large.
    """
    largest = np.abs(table).max()
    if not largest < MOST:
        raise ConfigError(
            f"{name} is too large for a replay: it reaches {largest:.3g} of its quanta, "
            f"and {MOST:.3g} are the limit."
        )
    steps = np.diff(table.astype(np.int64), axis=0, prepend=0).T.ravel()
    folded = np.where(steps < 0, -2 * steps - 1, 2 * steps).astype("<u4")
    width = max(1, (int(folded.max()).bit_length() + 7) // 8)
    return folded.view(np.uint8).reshape(-1, 4)[:, :width].T.tobytes(), width


def colours(robots: int) -> list[str]:
    """Gives every robot a colour.

    Args:
        robots: How many there are.

    Returns:
        A colour each, as #rrggbb.
    """
    if robots <= len(_PALETTE):
        return list(_PALETTE[:robots])
    found = [
        colorsys.hls_to_rgb(i * _GOLDEN % 1.0, (0.5, 0.62, 0.42)[i % 3], 0.62)
        for i in range(robots)
    ]
    return [f"#{''.join(f'{round(255 * part):02x}' for part in each)}" for each in found]


def dark(reach: float) -> int:
    """Returns the whole number that stands for a ray that meets nothing.

    Args:
        reach: Length that such a ray has, m.

    Returns:
        More than that of any shorter ray.
    """
    return int(np.ceil(reach / RAY))


def _columns(recording: Recording, reach: float) -> dict[str, np.ndarray]:
    """Returns the series [N, C] of a run by name, in whole numbers; C counts robots first."""
    rows = len(recording.pose)
    ray = np.where(recording.ray < reach, np.floor(recording.ray / RAY), dark(reach))
    touch = recording.touching @ np.array([1, 2, 4])
    series = {
        "x": recording.pose[..., 0] / LENGTH,
        "y": recording.pose[..., 1] / LENGTH,
        "yaw": recording.pose[..., 2] / ANGLE,
        "ray": ray,
        "touch": touch,
        "contacts": recording.contacts,
    }
    latched = (recording.arrival > 0) & (np.arange(rows)[:, None] >= recording.arrival)
    if (recording.arrived != latched).any():  # it left again: `arrival` alone does not say
        series["arrived"] = recording.arrived.astype(int)
    for name, term in recording.reward.items():
        series[f"reward.{name}"] = np.cumsum(term, axis=0) / REWARD
    return {name: np.rint(each).reshape(rows, -1) for name, each in series.items()}


def _describe(episode: ReplayEpisode) -> dict[str, Any]:
    """Returns what a level's header says, lengths in m to 10 um."""
    scene = episode.runs[0].scene
    sensor = scene.sensor
    if (sensor == sensor[:1]).all():
        sensor = sensor[:1]  # every robot has them where they should be
    return {
        "label": episode.label,
        "level": episode.level,
        "side": round(scene.side, 5),
        "target": scene.target.round(5).tolist(),
        "box": scene.box.round(5).tolist(),
        "sensor": sensor.round(5).tolist(),
        "colours": colours(len(scene.target)),
    }


def _describe_run(recording: Recording) -> dict[str, Any]:
    """Returns what a run's header says beside its series."""
    return {"frames": len(recording.pose), "arrival": recording.arrival.tolist()}
