"""The world that arenas run in: everything that is fixed in the compiled environment."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax

from swarmjax.config import ConfigError
from swarmjax.extension import NONE, Extensions, LevelDrawing, RewardTerm
from swarmjax.sim import dispatch, model, physics
from swarmjax.sim import drive as sim_drive
from swarmjax.sim.config import RobotConfig, SimConfig, physics_substeps
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import electronics as task_electronics
from swarmjax.task import extended, pieces, room
from swarmjax.task import factors as task_factors
from swarmjax.task import stage as task_stage
from swarmjax.task.config import TaskConfig
from swarmjax.task.electronics import Electronics
from swarmjax.task.goals import load as task_goals
from swarmjax.task.goals import own as own_goals
from swarmjax.task.goals.goal import Goal
from swarmjax.task.level import Spacing
from swarmjax.task.stage_config import StageConfig, make_room


@dataclass(frozen=True, eq=False)
class World:
    """Everything that is fixed in the compiled environment.

    Attributes:
      robot: settings of the robot.
      task: settings of the task.
      realism: sensor models, and factors drawn for each episode.
      physics: the compiled physics.
      spacing: sizes that levels are drawn with.
      drive: the robot's drive.
      electronics: the motors and sensors between policy and arena.
      goal: what the robots are asked to do.
      terms: reward terms of an extension, with their weights.
      drawings: level drawings of an extension.
    """

    robot: RobotConfig
    task: TaskConfig
    realism: RealismConfig
    physics: physics.Physics
    spacing: Spacing
    drive: sim_drive.Drive
    electronics: Electronics
    goal: Goal
    terms: tuple[tuple[RewardTerm, float], ...] = ()
    drawings: tuple[LevelDrawing, ...] = ()

    @property
    def observation_size(self) -> int:
        """Size of an observation, O."""
        return self.electronics.layout.size


def load(
    stages: Sequence[StageConfig],
    robot: RobotConfig | None = None,
    task: TaskConfig | None = None,
    realism: RealismConfig | None = None,
    sim: SimConfig | None = None,
    *,
    arenas: int = 1,
    extensions: Extensions = NONE,
) -> World:
    """Builds the world that `reset` and `step` run in, and puts the model on the device.

    Args:
      stages: stages to run; the model is compiled for their largest obstacle.
      robot: the robot. Here and in the settings below, None stands for the default.
      task: the task.
      realism: sensor models, and factors drawn for each episode.
      sim: physics engine, and largest numbers of robots and obstacles.
      arenas: largest number of arenas stepped together; only Warp uses it.
      extensions: extension pieces; `task` names the ones to use.

    Raises:
      ConfigError: Warp is selected but not installed, a solver cannot run here, or a piece of an
        extension is missing or returns a wrong shape.
    """
    robot, task = robot or RobotConfig(), task or TaskConfig()
    realism, sim = realism or RealismConfig(), make_room(sim or SimConfig(), stages)
    if jax.config.jax_enable_x64:
        raise ConfigError(
            "jax_enable_x64 is on, but arenas and learners compute in 32 bits: switch it off, as "
            "in JAX_ENABLE_X64=0."
        )
    chosen = pieces.choose(extensions, task, stages)
    extended.check(chosen, robot, robots=sim.robots, obstacles=sim.obstacles)
    goal = task_goals.load(task, robot, extensions.goals)
    for piece in extensions.goals:
        if piece.name == task.goal:
            own_goals.check(piece, goal, robot, sim.robots, sim.obstacles)
    size = model.ArenaSize(sim.robots, sim.obstacles, task_stage.largest_half(stages))
    spacing = Spacing(*size[:2], robot.hull_radius, task.target_radius)
    room.check(stages, spacing, chosen.drawings)
    return World(
        robot=robot,
        task=task,
        realism=realism,
        physics=_load_physics(size, robot, task, realism, sim, arenas),
        spacing=spacing,
        drive=sim_drive.from_config(robot),
        electronics=task_electronics.load(task, realism, own=chosen.observations, robot=robot),
        goal=goal,
        terms=chosen.terms,
        drawings=chosen.drawings,
    )


def _load_physics(
    size: model.ArenaSize,
    robot: RobotConfig,
    task: TaskConfig,
    realism: RealismConfig,
    sim: SimConfig,
    arenas: int,
) -> physics.Physics:
    """Compiles the model of one arena, and loads the engine that steps the arena."""
    largest = task_factors.largest(robot, realism)
    substeps, choice = physics_substeps(robot, sim.substeps), dispatch.choose(sim, largest)
    spec = model.build(largest, size, task.control_step / substeps, fixtures="world")
    spec.option.iterations, spec.option.ls_iterations = choice.iterations, choice.ls_iterations
    compiled = spec.compile()
    ids = model.ids(compiled, size)
    engine = dispatch.load_engine(compiled, ids, robot, choice, arenas)
    return physics.Physics(engine, compiled, ids, robot, substeps)
