"""Makes a video of a replay: MuJoCo's renderer draws the scene in 3-D and ffmpeg encodes it.

The scene is built from the recording only to be looked at: nothing is simulated again. Robots,
walls and obstacles have their true sizes. Targets are discs on the floor, with their true radius.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from swarmjax import epuck, outputs
from swarmjax.config import ConfigError
from swarmjax.pages import builder
from swarmjax.replay import pack
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.record import Recording, ReplayEpisode
from swarmjax.sim.model import HALF_HEIGHT

FRAME_RATE = 30  # 1/s
HOLD = 1.0  # s; the last frame of an episode stays this long
HEIGHT = 720  # px, as in scene.xml; one picture is 16:9, two side by side are 4:3 each
ELEVATION = math.radians(58.0)  # angle at which the camera looks down
FIELD_OF_VIEW = math.radians(40.0)  # vertical; as in scene.xml
_MARGIN = 1.06  # the picture shows an area larger than the arena by this factor
_WALL = 0.015  # m; half of a wall's drawn thickness
_FLAT = 5e-4  # m; half height of a target
_BOX, _CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER


def check() -> None:
    """Checks that videos can be made on this machine.

    Raises:
      ConfigError: If imageio or OpenGL is missing.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns about what the error below explains
            mujoco.Renderer(mujoco.MjSpec().compile(), 16, 16).close()
    except Exception as error:  # each platform's library raises its own errors
        raise ConfigError(
            f"video cannot be made here ({type(error).__name__}): run uv sync --extra video, and "
            "set MUJOCO_GL to egl (Debian's libegl1) or osmesa (libosmesa6)."
        ) from None


def write(
    path: Path,
    settings: ReplayConfig,
    episodes: Sequence[ReplayEpisode],
    report: Callable[[int], None] = lambda _: None,
) -> None:
    """Writes a video of episodes one after the other, with two policies side by side.

    Args:
      path: Path of the MP4 file.
      settings: The replay's settings.
      episodes: The recordings of each level.
      report: Called after each picture with the number of pictures added.

    Raises:
      ConfigError: If the file cannot be written.
    """
    import imageio.v2 as imageio

    try:
        with outputs.replacing(path) as temporary:
            film: Any = imageio.get_writer(temporary, fps=FRAME_RATE, quality=7)
            with film:
                for picture in _pictures(settings, episodes):
                    film.append_data(picture)
                    report(1)
    except OSError as error:
        raise outputs.unwritable("video", path, error) from None


def rows(settings: ReplayConfig, runs: Sequence[Recording]) -> list[int]:
    """Lists which row of a level's recordings each picture shows.

    Args:
      settings: The replay's settings, with the control step (s).
      runs: Recordings of the level, one per policy, [N, ...] each; N may differ.

    Returns:
      For each picture a row of the longest recording, counted from 0. The last row stays for
      `HOLD` seconds.
    """
    last = max(len(run.pose) for run in runs) - 1
    pace = 1.0 / (FRAME_RATE * settings.task.control_step)  # rows per picture
    moving = [math.floor(k * pace) for k in range(math.ceil(last / pace))]
    return moving + [last] * round(HOLD * FRAME_RATE)


def _pictures(settings: ReplayConfig, episodes: Sequence[ReplayEpisode]) -> Iterator[np.ndarray]:
    """Draws the pictures [height, width, 3]."""
    for _, _, runs in episodes:
        width = HEIGHT * 16 // 9 if len(runs) == 1 else HEIGHT * 4 // 3
        with ExitStack() as stack:
            shots = [_Shot(settings, run, width) for run in runs]
            for shot in shots:
                stack.callback(shot.renderer.close)
            for row in rows(settings, runs):
                yield np.concatenate([shot.draw(row) for shot in shots], axis=1)


class _Shot:
    """The camera and the scene of one recording; MuJoCo edits both in place."""

    def __init__(self, settings: ReplayConfig, recording: Recording, width: int) -> None:
        self.recording = recording
        self.model = build(settings, recording).compile()
        self.data = mujoco.MjData(self.model)
        robots = recording.pose.shape[1]
        self.targets = [self.model.geom(f"target{i}").id for i in range(robots)]
        self.renderer = mujoco.Renderer(self.model, HEIGHT, width)
        self.camera = mujoco.MjvCamera()
        self.camera.azimuth, self.camera.elevation = 90.0, -math.degrees(ELEVATION)
        self.camera.distance = camera_distance(recording.scene.side, width / HEIGHT)

    def draw(self, row: int) -> np.ndarray:
        """Draws a row of the recording, or the last row if the recording is shorter."""
        row = min(row, len(self.recording.pose) - 1)
        pose = self.recording.pose[row]
        self.data.mocap_pos[:, :2] = pose[:, :2]
        self.data.mocap_quat[:, 0] = np.cos(0.5 * pose[:, 2])
        self.data.mocap_quat[:, 3] = np.sin(0.5 * pose[:, 2])
        self.model.geom_pos[self.targets, :2] = self.recording.target[row]
        mujoco.mj_forward(self.model, self.data)
        self.renderer.update_scene(self.data, self.camera)
        return self.renderer.render()


def build(settings: ReplayConfig, recording: Recording) -> mujoco.MjSpec:
    """Describes the scene of an episode. Robots are mocap bodies, which `_Shot.draw` places.

    Args:
      settings: The replay's settings.
      recording: Recording of the episode.

    Returns:
      The spec; robot i is the mocap body i.
    """
    spec = mujoco.MjSpec.from_string(builder.read("replay/scene.xml"))
    half = 0.5 * recording.scene.side
    spec.geom("floor").size = [half, half, 1.0]
    _add_fixtures(spec, recording)
    names = pack.colours(recording.pose.shape[1])  # #rrggbb
    colours = [[*(part / 255.0 for part in bytes.fromhex(name[1:])), 1.0] for name in names]
    for i, ((x, y), colour) in enumerate(zip(recording.target[0], colours, strict=True)):
        size = [settings.task.target_radius, _FLAT, 0.0]
        disc = _add(spec.worldbody, _CYLINDER, size, [x, y, _FLAT], [*colour[:3], 0.45])
        disc.name = f"target{i}"
        _add_robot(spec, settings.robot.hull_radius, colour)
    return spec


def _add_fixtures(spec: mujoco.MjSpec, recording: Recording) -> None:
    """Adds see-through walls, and obstacles."""
    half = 0.5 * recording.scene.side
    for turn in range(4):
        bearing = 0.5 * math.pi * turn
        away = half + _WALL
        place = [away * math.cos(bearing), away * math.sin(bearing), HALF_HEIGHT]
        size = [_WALL, half + 2 * _WALL, HALF_HEIGHT]
        _add(spec.worldbody, _BOX, size, place, [0.45, 0.5, 0.58, 0.3], bearing)
    grey = [0.55, 0.57, 0.60, 1.0]
    for x, y, yaw, *edges in recording.scene.box:
        _add(spec.worldbody, _BOX, [*edges, HALF_HEIGHT], [x, y, HALF_HEIGHT], grey, yaw)


def _add_robot(spec: mujoco.MjSpec, radius: float, colour: list[float]) -> None:
    """Adds a robot: its hull, with an arrow that points ahead."""
    body = spec.worldbody.add_body(mocap=True)
    half, top = 0.5 * (epuck.HULL_TOP - epuck.HULL_BOTTOM), epuck.HULL_TOP
    _add(body, _CYLINDER, [radius, half, 0], [0, 0, half + epuck.HULL_BOTTOM], colour)
    for side in (1.0, -1.0):
        # Two bars form the head of the arrow.
        place = [0.18 * radius, side * 0.24 * radius, top]
        _add(body, _BOX, [0.4 * radius, 0.09 * radius, 1e-3], place, yaw=-side * 0.65)


def _add(
    body: mujoco.MjsBody,
    kind: mujoco.mjtGeom,
    size: Sequence[float],
    place: Sequence[float],
    colour: Sequence[float] = (1.0, 1.0, 1.0, 1.0),
    yaw: float = 0.0,
) -> Any:
    """Adds a geom without collisions."""
    turn = [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)]
    return body.add_geom(
        type=kind, size=size, pos=place, quat=turn, rgba=colour, contype=0, conaffinity=0
    )


def camera_distance(side: float, aspect: float) -> float:
    """Computes the distance of the camera from the middle of the floor.

    Args:
      side: Side of the arena, m.
      aspect: Width of a picture divided by its height.

    Returns:
      The least distance at which the whole arena with its walls is in the picture, plus a
      margin, m. For a corner p and the camera's axes ahead, right and up, the depth is
      distance + p.ahead. At this depth p.right and p.up must lie within the field of view.
    """
    half = 0.5 * side + 2 * _WALL
    corners = np.array(
        [[x, y, z] for x in (-half, half) for y in (-half, half) for z in (0.0, 2 * HALF_HEIGHT)]
    )
    ahead = np.array([0.0, math.cos(ELEVATION), -math.sin(ELEVATION)])
    up = np.array([0.0, math.sin(ELEVATION), math.cos(ELEVATION)])
    slope = math.tan(0.5 * FIELD_OF_VIEW) / _MARGIN
    tall = np.abs(corners @ up) / slope
    wide = np.abs(corners[:, 0]) / (slope * aspect)
    return float((np.maximum(tall, wide) - corners @ ahead).max())
