"""One arena: reset and step, pure functions that join the files beside this one.

`vmap` them over arenas. Nothing here resets by itself: a step reports what it came
to, and the rollout decides what comes next.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import chex
import jax.numpy as jnp
from flax import struct
from jax import Array

from swarmjax.config import TrainConfig
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import gaps as sim_gaps
from swarmjax.sim import infrared, model, physics
from swarmjax.task import observation, reward
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing


@dataclass(frozen=True, eq=False)
class World:
    """What fixes the compiled environment.

    Attributes:
      config: the run's config.
      physics: the compiled side of the physics.
      spacing: sizes that levels are drawn with.
      drive: the robot's drive.
    """

    config: TrainConfig
    physics: physics.Physics
    spacing: Spacing
    drive: sim_drive.Drive


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
      sim: `PhysicsState` at the edges of a rollout, `mjx.Data` inside.
      level: what the episode started from.
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
      done: [] the arena's episode is over.
      sound: [] the physics is finite.
    """

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    valid: Array
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
    sim = config.sim
    impl = physics.resolve_impl(sim.impl)
    largest = task_stage.largest_half(config.stage)
    size = model.ArenaSize(sim.max_robots, sim.max_obstacles, largest)
    spec = model.build(config.robot, size, config.task.control_step / sim.substeps)
    iterations, ls_iterations = physics.SOLVER_STEPS[impl]
    spec.option.iterations = sim.iterations or iterations
    spec.option.ls_iterations = sim.ls_iterations or ls_iterations
    compiled = spec.compile()
    ids = model.ids(compiled, size)
    engine = physics.load(compiled, ids, impl=impl, arenas=config.arenas, substeps=sim.substeps)
    spacing = Spacing(
        sim.max_robots, sim.max_obstacles, config.robot.hull_radius, config.task.target_radius
    )
    return World(config, engine, spacing, sim_drive.from_config(config.robot))


def reset(world: World, level: Level, stage: Array, cohort: Array) -> tuple[EnvState, Array]:
    """Starts an episode.

    Args:
      world: the compiled environment.
      level: what to start from.
      stage: [] index of the level's stage.
      cohort: [] the curriculum's cohort that the episode counts for.

    Returns:
      The state, its `sim` packed, and the first observation [R, O].
    """
    robots = level.present.shape[0]
    distance, _ = observation.to_target(level.start, level.target, jnp)
    state = EnvState(
        sim=physics.rest(level.start.reshape(-1)),
        level=level,
        stage=jnp.asarray(stage, jnp.int32),
        cohort=jnp.asarray(cohort, jnp.int32),
        clock=jnp.zeros((), jnp.int32),
        arrived=jnp.zeros(robots, bool),
        distance=distance,
        apart=jnp.full((robots, len(sim_gaps.KINDS)), sim_gaps.CONTACT_PAUSE),
        episode=Episode(
            reward=jnp.zeros(robots),
            contacts=jnp.zeros((robots, len(sim_gaps.KINDS)), jnp.int32),
            sensed=jnp.zeros(robots, jnp.int32),
            moving=jnp.zeros(robots, jnp.int32),
        ),
    )
    return state, observe(world, state)


def observe(world: World, state: EnvState) -> Array:
    """Observes an arena as it stands.

    Args:
      world: the compiled environment.
      state: the arena.

    Returns:
      [R, O] in the order of `observation.NAMES`.
    """
    pose = physics.poses(state.sim)
    distance, bearing = observation.to_target(pose, state.level.target, jnp)
    seen = _infrared(world, pose, state.level)
    return observation.observe(seen, distance, bearing, jnp)


def step(world: World, state: EnvState, action: Array) -> tuple[EnvState, TimeStep]:
    """Moves one arena on by one control step.

    Args:
      world: the compiled environment.
      state: the arena; `sim` is `mjx.Data`.
      action: [R, 2], -1..1 spans the command's range, what is beyond is clipped.

    Returns:
      The new state, and what the step came to.
    """
    chex.assert_shape(action, (state.level.present.shape[0], 2))
    active = state.level.present & ~state.arrived
    data, pose, sound = _move(world, state, action, active)
    seen = _infrared(world, pose, state.level)
    distance, bearing = observation.to_target(pose, state.level.target, jnp)
    arrives = active & (distance <= world.config.task.target_radius)
    gap = sim_gaps.gaps(
        pose, state.level.side, state.level.obstacle, world.config.robot.hull_radius, jnp
    )
    begins, apart = sim_gaps.count_contacts(gap, state.apart, world.config.task.control_step, jnp)
    begins = begins & state.level.present[:, None]
    earned = reward.Step(
        state.distance,
        distance,
        seen,
        world.config.task.sensor_range,
        arrives,
        begins & active[:, None],
    )
    valid = active & sound
    gained = jnp.where(valid, reward.total(earned, world.config.task.reward), 0.0)
    episode = _tally(state.episode, gained, begins, earned, valid)
    arrived = state.arrived | arrives
    clock = state.clock + 1
    timeout = clock >= world.config.task.step_limit
    new = replace(
        state,
        sim=data,
        clock=clock,
        arrived=arrived,
        distance=distance,
        apart=apart,
        episode=episode,
    )
    return new, TimeStep(
        observation=observation.observe(seen, distance, bearing, jnp),
        reward=gained,
        terminated=arrives,
        truncated=active & ~arrives & (timeout | ~sound),
        valid=valid,
        done=jnp.all(arrived | ~state.level.present) | timeout | ~sound,
        sound=sound,
    )


def _move(world: World, state: EnvState, action: Array, active: Array) -> tuple[Any, Array, Array]:
    """Lets the robots that are on their way drive; returns data, poses and whether it is sound."""
    command = sim_drive.command(action, world.drive, jnp)
    command = jnp.where(active[:, None], command, 0.0)
    wheels = sim_drive.wheel_speeds(command, world.drive, jnp)
    velocity = sim_drive.body_velocity(wheels, world.drive, jnp)
    data = physics.step(world.physics, state.sim, state.level.side, state.level.obstacle, velocity)
    sound = physics.is_finite(data)
    # What follows stays finite: an arena that broke is seen where it last was, and reset.
    pose = jnp.where(sound, physics.poses(data), physics.poses(state.sim))
    return data, pose, sound


def _infrared(world: World, pose: Array, level: Level) -> Array:
    """Returns ray lengths [R, K], m."""
    config = world.config
    radius, reach = config.robot.hull_radius, config.task.sensor_range
    return infrared.distances(pose, level.side, level.obstacle, radius, reach, jnp)


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
