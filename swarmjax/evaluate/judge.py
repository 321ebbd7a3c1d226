"""The judge: data that all arenas of an evaluation in MuJoCo's C engine share. No JAX."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np

from swarmjax import epuck, extension
from swarmjax.config import ConfigError, show
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.measures import MEASURES
from swarmjax.evaluate.rays import RayScene
from swarmjax.extension import Extensions, LevelDrawing, Observation
from swarmjax.policy import Policy, PolicyError
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import gaps
from swarmjax.sim import model as sim_model
from swarmjax.sim.config import physics_substeps
from swarmjax.sim.sensors import Pose
from swarmjax.task import electronics as task_electronics
from swarmjax.task import factors as task_factors
from swarmjax.task import level, observation, room
from swarmjax.task import stage as task_stage
from swarmjax.task.electronics import Electronics
from swarmjax.task.goals import load as task_goals
from swarmjax.task.goals.goal import Goal
from swarmjax.task.observation import View
from swarmjax.task.stage_config import StageConfig

SOLVER_ITERATIONS = 100  # MuJoCo's default limit; the solver stops earlier at its tolerance of 1e-8


@dataclass(frozen=True, kw_only=True, eq=False)
class Judge:
    """Data that all arenas of an evaluation share.

    Attributes:
      config: Settings of the evaluation.
      policy: The policy to evaluate.
      stage: Stage of the levels, with scalar fields [].
      spacing: Sizes for drawing levels.
      drive: The robot's drive, with the range of commands that the policy was trained for.
      electronics: The electronics between policy and world, with the observations that the policy
        was trained with.
      goal: What the robots are asked to do.
      model: The compiled arena.
      ids: Rows of the model's moving bodies.
      scene: The scene for infrared rays.
      geom_robot: For each geom, the index of the robot whose contact geom it is, else -1.
      geom_kind: For each geom, the kind of a contact with it, as an index into `gaps.KINDS`.
      substeps: Physics steps of a control step.
      own: Function that computes the extension's observations [A, R, E] from a view [A]; None if
        there are none.
    """

    config: EvaluateConfig
    policy: Policy
    stage: task_stage.Stage
    spacing: level.Spacing
    drive: sim_drive.Drive
    electronics: Electronics
    goal: Goal
    model: mujoco.MjModel
    ids: sim_model.Ids
    scene: RayScene
    geom_robot: np.ndarray
    geom_kind: np.ndarray
    substeps: int
    own: Callable[[View], np.ndarray] | None = None


def load(config: EvaluateConfig, trained: Policy, half: np.ndarray | None = None) -> Judge:
    """Compiles the arena of a stage, with as many robots and obstacles as the stage has.

    Args:
      config: Settings of the evaluation.
      trained: The policy to judge.
      half: [M, 2] half edges of the boxes in the levels to run, m. None means those of the
        stage's first level.

    Returns:
      The judge.

    Raises:
      PolicyError: The policy has other observations, or networks for too few robots.
    """
    check_policy(config, config.stage, config.policy, trained)
    extensions = extension.load(config.extensions)
    own = _observations(extensions, trained)
    stage = task_stage.single(config.stage, extensions.levels)
    robots, obstacles = config.stage.robots, config.stage.obstacles
    spacing = level.Spacing(robots, obstacles, config.robot.hull_radius, config.task.target_radius)
    example = draw_level(stage, spacing, config.seed, 0, extensions.levels)
    if room.must_check(config.stage, spacing.hull_radius):
        room.check_level(config.stage, example, spacing)
    compiled, ids = _compile(config, example.obstacle[:, 3:] if half is None else half)
    geom_robot, geom_kind = _geoms(compiled, ids)
    electronics = task_electronics.load(
        config.task, config.realism, trained.encoding, own, config.robot
    )
    return Judge(
        config=config,
        policy=trained,
        stage=stage,
        spacing=spacing,
        drive=sim_drive.from_config(config.robot)._replace(
            max_speed=trained.max_speed, max_turn_rate=trained.max_turn_rate
        ),
        electronics=electronics,
        goal=_load_goal(config, extensions),
        model=compiled,
        ids=ids,
        scene=RayScene(
            model=compiled,
            ids=ids,
            robot=config.robot,
            side=config.stage.sides[0],
            reach=electronics.reach,
        ),
        geom_robot=geom_robot,
        geom_kind=geom_kind,
        substeps=substeps(config),
        own=_look_by(own),
    )


def substeps(config: EvaluateConfig) -> int:
    """Returns the physics steps of a control step: on wheels, by default twice those of training.

    When a robot is blocked, its slipping wheels hop, because MuJoCo's contacts, like all
    convex contact models, separate sliding surfaces. The wheels hop by 1.3 mm with physics steps of
    16 ms, and by 0.8 mm with steps of 8 ms or less.
    """
    finer = 2 if config.robot.body == "wheeled" and config.substeps is None else 1
    return finer * physics_substeps(config.robot, config.substeps)


def _compile(config: EvaluateConfig, half: np.ndarray) -> tuple[mujoco.MjModel, sim_model.Ids]:
    """Compiles the arena with boxes of these half edges [M, 2]."""
    largest = task_stage.largest_half([config.stage])
    size = sim_model.ArenaSize(config.stage.robots, len(half), largest)
    timestep = config.task.control_step / substeps(config)
    robot = task_factors.largest(config.robot, config.realism)
    spec = sim_model.build(robot, size, timestep, ray_geoms=True)
    spec.option.iterations = SOLVER_ITERATIONS
    # If numbers are not finite, MuJoCo would silently reset the robots to the model's own places.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # The half edges are set before compiling, so that MuJoCo derives its bounds from them.
    for i, edges in enumerate(half):
        spec.geom(f"obstacle{i}_box").size[:2] = edges
    compiled = spec.compile()
    return compiled, sim_model.ids(compiled, size)


def _geoms(compiled: mujoco.MjModel, ids: sim_model.Ids) -> tuple[np.ndarray, np.ndarray]:
    """Returns `Judge.geom_robot` and `Judge.geom_kind`."""
    robot = np.full(compiled.ngeom, -1)
    kind = np.full(compiled.ngeom, gaps.KINDS.index("wall"))
    kind[ids.obstacle_geom] = gaps.KINDS.index("obstacle")
    for i in range(len(ids.hull_body)):
        hull = compiled.geom(f"robot{i}_hull").id
        robot[hull], kind[hull] = i, gaps.KINDS.index("robot")
    return robot, kind


def _observations(extensions: Extensions, trained: Policy) -> tuple[Observation, ...]:
    """Finds the observations of an extension that a policy uses, in the policy's order."""
    names = trained.meta.get("task", {}).get("observations", [])
    return tuple(each for name in names for each in extensions.observations if each.name == name)


def _load_goal(config: EvaluateConfig, extensions: Extensions) -> Goal:
    """Makes the goal; a goal of an extension runs with JAX."""
    goal = task_goals.load(config.task, config.robot, extensions.goals)
    own = [piece for piece in extensions.goals if piece.name == config.task.goal]
    if not own:
        return goal
    from swarmjax.task.goals import own as own_goals  # imports JAX, only for extensions

    taken = sorted({*goal.measures} & {*MEASURES})
    if taken:
        raise ConfigError(
            f"goal {config.task.goal} defines {', '.join(taken)}, which is built in: rename it."
        )
    own_goals.check(own[0], goal, config.robot, config.stage.robots, config.stage.obstacles)
    return own_goals.SideBySide(goal)


def _look_by(own: tuple[Observation, ...]) -> Callable[[View], np.ndarray] | None:
    """Compiles observations of an extension for many arenas at once."""
    if not own:
        return None
    import jax  # only for extensions

    from swarmjax.task import extended

    look = jax.jit(jax.vmap(partial(extended.look, own)))
    return lambda view: np.asarray(look(view))


def check_policy(
    config: EvaluateConfig, stage: StageConfig, path: str | None, trained: Policy
) -> None:
    """Refuses a policy that does not fit a stage.

    Args:
      config: Settings of the evaluation.
      stage: The stage.
      path: Path of the policy.
      trained: The policy.

    Raises:
      PolicyError: The policy has other observations, or networks for too few robots.
      ConfigError: The policy needs a part of an extension that is missing.
    """
    extensions, needs = extension.load(config.extensions), trained.meta.get("extensions", {})
    extension.check_needs(needs, extensions, str(path), ["observation", "network"])
    for kind, name in (("level", stage.level), ("goal", config.task.goal)):
        if name in needs.get(kind, {}):
            extension.check_needs(needs, extensions, str(path), [kind])
    layout = trained.meta["observation"]
    own, poses = _observations(extensions, trained), config.robot.sensor_poses
    _check_sensors(path, trained, poses)
    for key, expected in observation.describe(trained.encoding, own, len(poses)).items():
        given = layout.get(key)
        if given != expected:
            raise PolicyError(
                f"{path} was trained with observations that this robot does not have: the policy's "
                f"meta.observation.{key} is {_list(given)}, expected {_list(expected)}."
            )
    learners = len(trained.log_std)
    if not trained.is_shared and stage.robots > learners:
        raise PolicyError(
            f"{path} holds a network for each of {learners} robots, but stage {stage.name} has "
            f"{stage.robots} robots: give a shared policy, or a stage with 1 to {learners} robots."
        )


def _check_sensors(path: str | None, trained: Policy, poses: Sequence[Pose]) -> None:
    """Refuses a policy that was trained with other sensors."""
    theirs = trained.meta.get("sensors", {}).get("poses", epuck.SENSOR_POSES)
    if [*map(tuple, theirs)] != [*map(tuple, poses)]:
        raise PolicyError(
            f"{path} was trained with other sensors: the policy's meta.sensors.poses is "
            f"{show(theirs)}, but robot.sensor_poses is {show(poses)}: keep robot and "
            "robot.sensor_poses as trained, or train a policy for this robot."
        )


def _list(values: Any) -> str:
    """Formats a few values for a sentence."""
    return ", ".join(map(str, values)) if isinstance(values, list | tuple) else str(values)


def draw_level(
    stage: task_stage.Stage,
    spacing: level.Spacing,
    seed: int,
    episode: int,
    drawings: Sequence[LevelDrawing] = (),
) -> level.Level:
    """Draws the level of an episode.

    Args:
      stage: Fields [].
      spacing: Sizes.
      seed: Seed of the evaluation.
      episode: Number of the episode.
      drawings: Level drawings of an extension, in the order that `stage.drawing` counts.

    Returns:
      The level, as NumPy arrays.
    """
    count = level.uniform_count(spacing)
    uniforms = np.random.default_rng([seed, episode]).random(count, dtype=np.float32)
    drawn = level.sample(uniforms, stage, spacing, np)
    if not stage.drawing:
        return drawn
    from swarmjax.task import extended  # imports JAX, only for extensions

    return extended.redraw(drawings[int(stage.drawing) - 1], drawn)
