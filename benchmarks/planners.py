"""Drives robots with local planners of `navground`, which get exact positions and the map.

The planners are `orca` (van den Berg et al. 2011, reciprocal collision avoidance), `hrvo` (Snape et
al. 2011, hybrid reciprocal velocity obstacles), `hl` (Guzzi et al. 2013, human-like navigation) and
`social_force` (Helbing & Molnar 1995). The robots follow the way-points of `benchmarks.way_points`
within the limits of their wheels. Robots that have arrived stand still, and other robots treat them
as static obstacles.
"""

import importlib
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from benchmarks import way_points
from benchmarks.way_points import Plan
from swarmjax.config import ConfigError
from swarmjax.evaluate.engine_c import Arenas
from swarmjax.evaluate.judge import Judge
from swarmjax.sim.drive import Drive

# Settings that differ from navground's defaults, in m and s. The defaults are for pedestrians or
# for robots several times as large and fast. The settings were chosen on levels of s6 and
# crowd_dense with seed 7.
SETTINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "orca": ("ORCA", {"time_horizon": 2.0, "static_time_horizon": 0.5}),
    "hrvo": ("HRVO", {}),
    "hl": ("HL", {}),
    "social_force": ("SocialForce", {"u_a": 0.1, "u_r": 0.012, "v_a": 0.3, "v_r": 0.02}),
}
SAFETY = 0.004  # m; safety margin that a planner adds to the hull
ROTATION = 0.2  # s; time in which a robot turns to its desired direction
SIGHT = 0.4  # m; planners see robots and obstacles up to this distance, 3.2 s away at full speed


class PlannersMemory(NamedTuple):
    """The data that the planners keep from one control step to the next.

    Attributes:
      scene: [A] the arenas' scenes.
      pose: [A, R, 3] robots' poses one control step ago, m and rad.
    """

    scene: np.ndarray
    pose: np.ndarray


class Scene(NamedTuple):
    """The paths, planners and obstacles of an arena, which do not change during an episode.

    Attributes:
      plan: the paths to the targets.
      behavior: [R] each robot's planner, a `Behavior` of navground.
      segment: [M] outlines of the obstacles, each a list of navground's line segments.
      centre: [M, 2] centres of the obstacles, m; the walls come last.
      radius: [M] radii of circles around the obstacles, m.
    """

    plan: Plan
    behavior: list[Any]
    segment: list[list[Any]]
    centre: np.ndarray
    radius: np.ndarray


@dataclass(frozen=True)
class Planners:
    """A controller for `engine_c.simulate` that takes each robot's action from a planner.

    Attributes:
      name: a key of `SETTINGS`.
      drive: the robots' drive.
      hull_radius: radius of the hull, m.
      target_radius: radius of a target, m.
      control_step: time per control step, s.
    """

    name: str
    drive: Drive
    hull_radius: float
    target_radius: float
    control_step: float

    def init(self, arenas: Arenas) -> PlannersMemory:
        """Returns the planners' memory at the start of episodes."""
        scene = np.empty(len(arenas.pose), object)
        for i in range(len(scene)):
            parts = arenas.level.side[i], arenas.target[i], arenas.obstacle[i]
            scene[i] = self._scene(float(parts[0]), *parts[1:])
        return PlannersMemory(scene, arenas.pose)

    def _scene(self, side: float, target: np.ndarray, obstacle: np.ndarray) -> Scene:
        core, walls = navground(), _walls(side)
        outline = [_segments(core, each) for each in (*obstacle, *walls)]
        boxes = np.concatenate([obstacle, walls])
        return Scene(
            plan=way_points.plan(side, target, obstacle, self.hull_radius),
            behavior=[self._behavior(core) for _ in target],
            segment=outline,
            centre=boxes[:, :2],
            radius=np.hypot(boxes[:, 3], boxes[:, 4]),
        )

    def _behavior(self, core: Any) -> Any:
        """Makes the planner of one robot."""
        kind, settings = SETTINGS[self.name]
        behavior, drive = core.Behavior.make_type(kind), self.drive
        behavior.kinematics = core.kinematics.TwoWheelsDifferentialDriveKinematics(
            drive.max_wheel_speed * drive.wheel_radius,
            drive.track,
            drive.max_turn_rate,
            drive.max_speed,
            0.0,
        )
        behavior.radius, behavior.safety_margin = self.hull_radius, SAFETY
        behavior.optimal_speed, behavior.horizon = drive.max_speed, SIGHT
        behavior.optimal_angular_speed, behavior.rotation_tau = drive.max_turn_rate, ROTATION
        for name, value in settings.items():
            behavior.set(name, value)
        return behavior

    def act(self, memory: PlannersMemory, arenas: Arenas) -> tuple[PlannersMemory, np.ndarray]:
        """Computes the robots' actions for one control step."""
        gone = arenas.pose - memory.pose
        gone[..., 2] = (gone[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
        distance = np.linalg.norm(arenas.target - arenas.pose[..., :2], axis=-1)
        there = arenas.outcome.arrived | (distance <= self.target_radius)
        parts = zip(
            memory.scene, arenas.pose, gone / self.control_step, arenas.target, there, strict=True
        )
        twist = np.stack([self._drive(*each) for each in parts])
        speed = 2.0 * twist[..., 0] / self.drive.max_speed - 1.0
        action = np.stack([speed, twist[..., 1] / self.drive.max_turn_rate], axis=-1)
        return memory._replace(pose=arenas.pose), action

    def _drive(
        self,
        scene: Scene,
        pose: np.ndarray,
        twist: np.ndarray,
        target: np.ndarray,
        there: np.ndarray,
    ) -> np.ndarray:
        """Computes the robots' speeds (m/s) and turn rates (rad/s), [R, 2]; 0 after arrival."""
        core, place = navground(), pose[:, :2]
        goal = way_points.way_points(scene.plan, place, target)
        apart = np.linalg.norm(place[:, None] - place, axis=-1) + np.where(
            np.eye(len(place)), 9.0, 0.0
        )
        off = np.linalg.norm(place[:, None] - scene.centre, axis=-1) - scene.radius
        discs = [core.Disc(each, self.hull_radius) for each in place]
        moving = [
            core.Neighbor(place[i], self.hull_radius, twist[i, :2], i) for i in range(len(place))
        ]
        found = np.zeros((len(place), 2))
        for i in np.flatnonzero(~there):
            behavior = scene.behavior[i]
            behavior.pose = core.Pose2(place[i], pose[i, 2])
            behavior.twist = core.Twist2(twist[i, :2], twist[i, 2])
            behavior.target = core.Target.Point(goal[i])
            near = np.flatnonzero(apart[i] < SIGHT)
            state = behavior.environment_state
            state.neighbors = [moving[k] for k in near if not there[k]]
            state.static_obstacles = [discs[k] for k in near if there[k]]
            close = np.flatnonzero(off[i] < SIGHT)
            state.line_obstacles = [each for k in close for each in scene.segment[k]]
            command = behavior.compute_cmd(self.control_step, core.Frame.relative, True)
            found[i] = command.velocity[0], command.angular_speed
        return found


def navground() -> Any:
    """Imports `navground`.

    Raises:
      ConfigError: if `navground` is not installed.
    """
    try:
        return importlib.import_module("navground.core")
    except ImportError as error:
        raise ConfigError(f"navground is missing ({error}): install the extra navground.") from None


def check_packages() -> None:
    """Imports the packages of the extra `navground`, to check that they are installed.

    Raises:
      ConfigError: if one of the packages is missing.
    """
    navground()
    way_points.scipy()


def load(name: str, judge: Judge) -> Planners:
    """Makes the controller for a judge's robots; `name` is a key of `SETTINGS`."""
    task, robot = judge.config.task, judge.config.robot
    return Planners(name, judge.drive, robot.hull_radius, task.target_radius, task.control_step)


def _walls(side: float) -> np.ndarray:
    """Returns the walls [4, 5] of an arena as boxes without thickness."""
    half = 0.5 * side
    return np.array([[x * half, y * half, 0.0, abs(y) * half, abs(x) * half] for x, y in _SIDES])


_SIDES = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
_CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def _segments(core: Any, box: np.ndarray) -> list[Any]:
    """Returns the outline of a box [5] as line segments; a wall is a single segment."""
    cos, sin = np.cos(box[2]), np.sin(box[2])
    corner = box[:2] + (_CORNERS * box[3:]) @ np.array([[cos, sin], [-sin, cos]])
    if not box[3:].all():
        return [core.LineSegment(corner[0], corner[2])]
    return [core.LineSegment(corner[i - 1], corner[i]) for i in range(4)]
