"""Runs episodes in MuJoCo's C engine, and records them step by step.

JAX is needed only to measure shortest paths.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from swarmjax import policy
from swarmjax.config.section import build_stored
from swarmjax.evaluate import contacts, engine_c
from swarmjax.evaluate.engine_c import Arenas, Judge
from swarmjax.policy import Policy
from swarmjax.sim import infrared
from swarmjax.task import observation, reward
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.level import Level


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayScene:
    """The parts of an episode that do not move.

    Attributes:
      side: Side of the arena, m.
      box: [B, 5] x (m), y (m), yaw (rad), half edges (m) of the boxes that form the obstacles.
      sensor: [R, K, 4] origin (m) and unit direction of each infrared ray, in the robot's frame.
    """

    side: float
    box: np.ndarray
    sensor: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """What robots do in N frames of A arenas. Frame 0 is the start. Recordings have no axis A.

    Attributes:
      pose: [N, A, R, 3] x (m), y (m), yaw (rad) of the robot.
      target: [N, A, R, 2] x (m), y (m) of the robot's target.
      ray: [N, A, R, K] length of each infrared ray, m; at most the range of the electronics.
      distance: [N, A, R] distance to the target, m.
      touching: [N, A, R, 3] whether the robot touches something of each kind of `gaps.KINDS`.
      arrived: [N, A, R] whether the robot has arrived; with `task.arrival=hold`, whether it is
        within its target.
      contacts: [N, A, R, 3] number of contacts so far, of each kind of `gaps.KINDS`.
      earns: [N, A, R] whether the robot earns the reward `arrival`.
      measured: [N, A, K] the values so far of the goal's own K measures.
    """

    pose: np.ndarray
    target: np.ndarray
    ray: np.ndarray
    distance: np.ndarray
    touching: np.ndarray
    arrived: np.ndarray
    contacts: np.ndarray
    earns: np.ndarray
    measured: np.ndarray

    def take(self, rows: Any) -> "Frames":
        """Indexes every field with `rows`."""
        return Frames(**{name: field[rows] for name, field in vars(self).items()})


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording(Frames):
    """A recorded episode: its frames, without the axis A. N is 1 + the number of control steps.

    Attributes:
      scene: The parts that do not move.
      reward: [N, R] weighted reward, by term, of the control step that led to the frame. The reward
        is 0 at the start and, with `task.arrival=latch`, after the robot's arrival.
      arrival: [R] control steps until the robot arrived, or 0 if it never arrived. With
        `task.arrival=hold`, control steps until the robot reached its target for good.
    """

    scene: ReplayScene
    reward: Mapping[str, np.ndarray]
    arrival: np.ndarray


class ReplayEpisode(NamedTuple):
    """The recordings of one level.

    Attributes:
      label: Title for people: the level, and how the episode ended.
      level: Number of the level.
      runs: One recording per policy.
    """

    label: str
    level: int
    runs: list[Recording]


def weights(trained: Policy, task: TaskConfig) -> RewardConfig:
    """Returns the reward weights in a policy's file, or those of `task` if the file has none.

    Raises:
      ConfigError: If the weights in the file are invalid.
    """
    stored = trained.meta["config"].get("task", {})
    if "reward" not in stored:
        return task.reward
    return build_stored(RewardConfig, stored["reward"], "the policy's config.task.reward.")


def record(judge: Judge, levels: Sequence[Level]) -> list[Recording]:
    """Runs episodes side by side and records everything that a replay shows.

    Args:
      judge: Everything that the arenas share.
      levels: The level of each arena.

    Returns:
      A recording of each episode, which ends when all robots have arrived or the time is up.

    Raises:
      ConfigError: If the physics of an episode breaks down, or the policy's weights are invalid.
    """
    earning = weights(judge.policy, judge.config.task)
    arenas = engine_c.start(judge, levels)
    yaw, poses = arenas.factors.infrared_yaw, judge.config.robot.sensor_poses
    frames = [_look(judge, arenas)]
    # With `task.arrival=hold`, robots may leave their targets again, but an episode that is over
    # stays over.
    over = np.zeros(len(levels), bool)
    memory = policy.begin(judge.policy, arenas.pose.shape[:2])
    while len(frames) <= judge.config.step_limit and not over.all():
        memory, action = engine_c.act(judge, memory, arenas)
        arenas = engine_c.step(judge, arenas, action)
        frames.append(_look(judge, arenas))
        over |= engine_c.is_over(judge, arenas.outcome)
    every = Frames(**{name: np.stack([each[name] for each in frames]) for name in frames[0]})
    recordings = []
    for i, level in enumerate(levels):
        scene = _scene(level, infrared.Mount(poses, None if yaw is None else yaw[i]))
        recordings.append(_cut(every.take(np.s_[:, i]), level, scene, judge, earning))
    return recordings


def _look(judge: Judge, arenas: Arenas) -> dict[str, np.ndarray]:
    """Records one frame of all arenas: the fields of `Frames` without the axis N."""
    sight = engine_c.look(
        judge, arenas.data, arenas.factors, arenas.pose, arenas.target, arenas.obstacle
    )
    return {
        "pose": arenas.pose,
        "target": arenas.target,
        "ray": sight.ray,
        "distance": sight.distance,
        "touching": contacts.touching(judge, arenas.data),
        "arrived": arenas.outcome.arrived,
        "contacts": arenas.outcome.contacts,
        "earns": arenas.earns,
        "measured": arenas.outcome.measured,
    }


def _cut(
    frames: Frames, level: Level, scene: ReplayScene, judge: Judge, earning: RewardConfig
) -> Recording:
    """Makes the recording of one arena from its frames [N, ...], up to the end of its episode."""
    goal = judge.goal
    over = goal.is_over(frames.arrived, np.ones_like(frames.arrived))
    frames = frames.take(np.s_[: over.argmax() + 1 if over.any() else None])
    before = frames.arrived[:-1]
    # The reward of a step is for the target that the robot had when the step began, even if the
    # robot gets another target in this step.
    distance, _ = observation.to_target(frames.pose[1:], frames.target[:-1], np)
    steps = reward.Step(
        distance_before=frames.distance[:-1],
        distance=distance,
        infrared=frames.ray[1:],
        sensor_range=judge.config.robot.sensor_range,
        arrives=frames.earns[1:],
        contact_begins=np.diff(frames.contacts, axis=0),
        touching=frames.touching[1:],
        outside=goal.is_under_way(before),
    )
    if earning.path_progress:
        path = _measure_paths(level, frames.pose, judge.config.robot.hull_radius)
        steps = steps._replace(path_before=path[:-1], path=path[1:])
    return Recording(
        **vars(frames) | {"ray": np.minimum(frames.ray, judge.config.robot.sensor_range)},
        scene=scene,
        reward={
            name: np.pad(np.where(goal.drives(before), term, 0.0), ((1, 0), (0, 0)))
            for name, term in reward.weighted(steps, earning).items()
        },
        arrival=_since(frames.arrived),
    )


def _measure_paths(level: Level, pose: np.ndarray, hull_radius: float) -> np.ndarray:
    """Measures the shortest paths [N, R] (m) from poses [N, R, 3] to targets, as training does."""
    import jax  # only for rewards along paths

    from swarmjax.task import geodesic

    level, place = jax.tree.map(jax.numpy.asarray, (level, pose[1:, :, :2].astype(np.float32)))

    def follow(path: geodesic.Path, now: jax.Array) -> tuple[geodesic.Path, jax.Array]:
        path = geodesic.go_on(path, now, level, hull_radius)
        return path, path.distance

    first = geodesic.begin(level, hull_radius)
    return np.concatenate([first.distance[None], jax.lax.scan(follow, first, place)[1]])


def _since(arrived: np.ndarray) -> np.ndarray:
    """Finds for each robot [R] the row of `arrived` [N, R] from which on all rows are True.

    The result is 0 for a robot that has not arrived in the last row.
    """
    away = len(arrived) - 1 - np.argmin(arrived[::-1], axis=0)  # the last row outside the target
    return np.where(arrived[-1], away + 1, 0)


def _scene(level: Level, mount: infrared.Mount) -> ReplayScene:
    """Records the fixed parts of an arena."""
    origin, toward = infrared.rays(np.zeros((len(level.target), 3)), np, mount)  # at the origin
    return ReplayScene(
        side=float(level.side),
        box=level.obstacle[level.obstacle_present].astype(float),
        sensor=np.concatenate([origin, toward], axis=-1),
    )
