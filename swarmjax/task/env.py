"""One arena: reset and step, pure functions that join the files beside this one.

`vmap` them over arenas. Nothing here resets by itself: a step reports what it came
to, and the rollout decides what comes next.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from swarmjax.config import TrainConfig, substeps
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import gaps as sim_gaps
from swarmjax.sim import infrared, model, physics
from swarmjax.task import electronics as task_electronics
from swarmjax.task import factors as task_factors
from swarmjax.task import observation, reward
from swarmjax.task import stage as task_stage
from swarmjax.task.electronics import Electronics, Memory, Sight
from swarmjax.task.factors import Factors
from swarmjax.task.level import Level, Spacing


@dataclass(frozen=True, eq=False)
class World:
    """What fixes the compiled environment.

    Attributes:
      config: the run's config.
      physics: the compiled side of the physics.
      spacing: sizes that levels are drawn with.
      drive: the robot's drive.
      electronics: what lies between policy and world.
    """

    config: TrainConfig
    physics: physics.Physics
    spacing: Spacing
    drive: sim_drive.Drive
    electronics: Electronics


class Episode(NamedTuple):
    """What an episode has come to so far.

    Attributes:
      reward: [R] sum of rewards.
      contacts: [R, 3] contacts of each kind.
      sensed: [R] control steps with an infrared ray shorter than its range (the paper's
        collision rule).
      moving: [R] control steps before arrival.
    """

    reward: Array
    contacts: Array
    sensed: Array
    moving: Array


@struct.dataclass
class EnvState:
    """State of one arena, or with a leading axis of many.

    Attributes:
      sim: `PhysicsState` at the edges of a rollout, the physics' data inside.
      level: what the episode started from.
      factors: what realism makes of the episode; they follow from the level's seed.
      memory: what the robots' electronics carry along.
      observation: [R, O] what the policy sees now.
      stage: [] index of the stage on which the episode began, int32.
      cohort: [] the curriculum's cohort in which it began, int32.
      clock: [] control steps since the start, int32.
      arrived: [R] whether the robot has arrived.
      distance: [R] to the target, m.
      apart: [R, 3] for how long there was no contact of each kind, s.
      episode: sums since the start.
    """

    sim: Any
    level: Level
    factors: Factors
    memory: Memory
    observation: Array
    stage: Array
    cohort: Array
    clock: Array
    arrived: Array
    distance: Array
    apart: Array
    episode: Episode


class TimeStep(NamedTuple):
    """What a control step came to, all of it before any reset.

    Attributes:
      observation: [R, O].
      reward: [R].
      terminated: [R] the robot arrived in this step.
      truncated: [R] the time ran out for the robot.
      valid: [R] the robot was on its way, and the physics sound: a transition to learn from.
      robot_contact: [R] a contact with another robot began, before arrival.
      done: [] the arena's episode is over.
      sound: [] the physics is finite.
    """

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    valid: Array
    robot_contact: Array
    done: Array
    sound: Array


def load(config: TrainConfig) -> World:
    """Builds the model and puts it on the device.

    Args:
      config: the run's config.

    Returns:
      The world that `reset` and `step` run in.

    Raises:
      ConfigError: if Warp is asked for and not installed.
    """
    sim, count = config.sim, substeps(config.robot, config.sim.substeps)
    impl = physics.resolve_impl(sim.impl)
    largest = task_stage.largest_half(config.stage)
    size = model.ArenaSize(sim.max_robots, sim.max_obstacles, largest)
    robot = task_factors.largest(config.robot, config.realism)
    spec = model.build(robot, size, config.task.control_step / count, fixtures="world")
    solver = resolve_solver(config)
    iterations, ls_iterations = physics.solver_steps(solver, impl, config.robot.body)
    spec.option.iterations = sim.iterations or iterations
    spec.option.ls_iterations = sim.ls_iterations or ls_iterations
    compiled = spec.compile()
    engine = physics.load(
        compiled,
        model.ids(compiled, size),
        config.robot,
        impl=impl,
        solver=solver,
        arenas=config.arenas * (config.seeds if config.seeds_by == "vmap" else 1),
        substeps=count,
    )
    spacing = Spacing(
        sim.max_robots, sim.max_obstacles, config.robot.hull_radius, config.task.target_radius
    )
    electronics = task_electronics.load(config.task, config.realism)
    return World(config, engine, spacing, sim_drive.from_config(config.robot), electronics)


def resolve_solver(config: TrainConfig) -> str:
    """Says which solver a run uses: `newton` or `swarm`.

    Raises:
      ConfigError: if it asks for one that cannot be.
    """
    sim, impl = config.sim, physics.resolve_impl(config.sim.impl)
    return physics.resolve_solver(sim.solver, impl, config.robot.body, sim.max_robots)


def reset(world: World, level: Level, stage: Array, cohort: Array) -> EnvState:
    """Starts an episode.

    Args:
      world: the compiled environment.
      level: what to start from.
      stage: [] index of the level's stage.
      cohort: [] the curriculum's cohort that the episode counts for.

    Returns:
      The state, its `sim` packed.
    """
    robots, obstacles = level.present.shape[0], level.obstacle_present.shape[0]
    realism, robot = world.config.realism, world.config.robot
    factors = task_factors.draw(level.seed, realism, robot, robots, obstacles, jnp)
    sight = _look(world, level.start, level, factors)
    clock = jnp.zeros((), jnp.int32)
    memory, seen = task_electronics.begin(world.electronics, factors, sight, clock, jnp)
    return EnvState(
        sim=physics.rest(world.physics, level.start),
        level=level,
        factors=factors,
        memory=memory,
        observation=seen,
        stage=jnp.asarray(stage, jnp.int32),
        cohort=jnp.asarray(cohort, jnp.int32),
        clock=clock,
        arrived=jnp.zeros(robots, bool),
        distance=sight.distance,
        apart=jnp.full((robots, len(sim_gaps.KINDS)), sim_gaps.CONTACT_PAUSE),
        episode=_no_episode(robots),
    )


def _no_episode(robots: int) -> Episode:
    """Returns the sums of an episode that has just begun."""
    return Episode(
        reward=jnp.zeros(robots),
        contacts=jnp.zeros((robots, len(sim_gaps.KINDS)), jnp.int32),
        sensed=jnp.zeros(robots, jnp.int32),
        moving=jnp.zeros(robots, jnp.int32),
    )


def step(world: World, state: EnvState, action: Array) -> tuple[EnvState, TimeStep]:
    """Moves one arena on by one control step.

    Args:
      world: the compiled environment.
      state: the arena; `sim` is the physics' data.
      action: [R, 2], -1..1 spans the command's range, what is beyond is clipped.

    Returns:
      The new state, and what the step came to.
    """
    chex.assert_shape(action, (state.level.present.shape[0], 2))
    active = state.level.present & ~state.arrived
    clock = state.clock + 1
    data, memory, pose, sound = _move(world, state, action, active)
    sight = _look(world, pose, state.level, state.factors)
    memory, seen = task_electronics.sense(
        world.electronics, memory, state.factors, sight, clock, jnp
    )
    arrives = active & (sight.distance <= world.config.task.target_radius)
    gap = sim_gaps.gaps(
        pose, state.level.side, state.level.obstacle, world.config.robot.hull_radius, jnp
    )
    begins, apart = sim_gaps.count_contacts(gap, state.apart, world.config.task.control_step, jnp)
    begins = begins & state.level.present[:, None]
    earned = reward.Step(
        state.distance,
        sight.distance,
        sight.ray,
        world.config.task.sensor_range,
        arrives,
        begins & active[:, None],
    )
    valid = active & sound
    gained = jnp.where(valid, reward.total(earned, world.config.task.reward), 0.0)
    episode = _tally(state.episode, gained, begins, earned, valid)
    arrived = state.arrived | arrives
    timeout = clock >= world.config.task.step_limit
    new = replace(
        state,
        sim=data,
        memory=memory,
        observation=seen,
        clock=clock,
        arrived=arrived,
        distance=sight.distance,
        apart=apart,
        episode=episode,
    )
    return new, TimeStep(
        observation=seen,
        reward=gained,
        terminated=arrives,
        truncated=active & ~arrives & (timeout | ~sound),
        valid=valid,
        robot_contact=reward.robot_contact(earned),
        done=jnp.all(arrived | ~state.level.present) | timeout | ~sound,
        sound=sound,
    )


def _move(
    world: World, state: EnvState, action: Array, active: Array
) -> tuple[Any, Memory, Array, Array]:
    """Lets the robots that are on their way drive.

    Returns:
      Data, memory, poses, and whether the physics is sound.
    """
    found, level = state.factors, state.level
    command = sim_drive.command(action, world.drive, jnp)
    memory, wheels = task_electronics.drive(
        world.electronics, state.memory, found, command, world.drive, state.clock, jnp
    )
    wheels = jnp.where(active[:, None], wheels, 0.0)
    chassis = task_electronics.chassis(found)
    data = physics.step(world.physics, state.sim, level.side, level.obstacle, wheels, chassis)
    sound = physics.is_finite(data)
    # What follows stays finite: an arena that broke is seen where it last was, and reset.
    before, after = (physics.poses(world.physics, each) for each in (state.sim, data))
    return data, memory, jnp.where(sound, after, before), sound


def _look(world: World, pose: Array, level: Level, factors: Factors) -> Sight:
    """Works out what there is to be sensed at poses [R, 3]."""
    distance, bearing = observation.to_target(pose, level.target, jnp)
    radius, reach = world.config.robot.hull_radius, world.electronics.reach
    mount, shades = task_electronics.mount(factors), task_electronics.reflectance(factors)
    arena = (pose, level.side, level.obstacle, radius, reach)
    if shades is None:
        ray, bright = infrared.distances(*arena, jnp, mount), None
    else:
        ray, bright = infrared.sights(*arena, shades, mount, jnp)
    # Looked at by several: without the barrier XLA works rays out anew for each, on a GPU.
    ray, bright = jax.lax.optimization_barrier((ray, bright))
    return Sight(ray, bright, distance, bearing)


def _tally(
    episode: Episode, gained: Array, begins: Array, earned: reward.Step, valid: Array
) -> Episode:
    """Adds a step to the sums of the episode."""
    sensed = valid & (reward.proximity(earned) > 0.0)
    return Episode(
        reward=episode.reward + gained,
        contacts=episode.contacts + begins,
        sensed=episode.sensed + sensed,
        moving=episode.moving + valid,
    )
