"""Reset and step of one arena, as pure functions.

Use `vmap` to run many arenas. A step does not reset an arena: it reports its outcome, and the
rollout decides whether to reset.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import chex
import jax.numpy as jnp
from flax import struct
from jax import Array

from swarmjax.sim import dispatch, physics, senses
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import gaps as sim_gaps
from swarmjax.sim.senses import Surround
from swarmjax.task import electronics as task_electronics
from swarmjax.task import (
    extended,
    geodesic,
    observation,
    reward,
    surroundings,
)
from swarmjax.task import factors as task_factors
from swarmjax.task.electronics import Memory, Sight
from swarmjax.task.episode import Episode
from swarmjax.task.factors import Factors
from swarmjax.task.goals.goal import Turn
from swarmjax.task.level import Level
from swarmjax.task.world import World


@struct.dataclass
class EnvState:
    """State of one arena, or of many arenas with a leading axis.

    Attributes:
      sim: a `PhysicsState` before and after a rollout; during a rollout, the engine's own data.
      level: the level that the episode started from, with the current targets.
      factors: realism factors of the episode, drawn from the level's seed.
      memory: state of the robots' electronics.
      observation: [R, O] input of the policy.
      clock: [] control steps since the start, int32.
      goal: state of the goal.
      arrived: [R] whether the robot has arrived; with `task.arrival=hold`, whether it is at its
        target now.
      distance: [R] distance to the target, m.
      apart: [R, 3] time since the last contact of each kind ended, s.
      episode: sums since the start of the episode.
      path: the shortest paths to the targets; None if the reward does not use them.
    """

    sim: Any
    level: Level
    factors: Factors
    memory: Memory
    observation: Array
    clock: Array
    goal: Any
    arrived: Array
    distance: Array
    apart: Array
    episode: Episode
    path: geodesic.Path | None


class TimeStep(NamedTuple):
    """Outcome of a control step, before any reset.

    Attributes:
      observation: [R, O].
      reward: [R].
      terminated: [R] whether the robot arrived in this step; with `task.arrival=hold`, whether all
        robots are at their targets.
      truncated: [R] whether the robot ran out of time.
      valid: [R] whether to learn from the transition: the robot was driving (with `latch`, it had
        not arrived before) and the arena is `sound`.
      done: [] whether the arena's episode is over.
      sound: [] whether physics, rewards, distances and observations are all finite, and no robot
        has more neighbours than `neighbours.room` allows for.
      measured: [K] current values of the goal's own measures.
    """

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    valid: Array
    done: Array
    sound: Array
    measured: Array


def reset(world: World, level: Level) -> EnvState:
    """Starts an episode.

    Args:
      world: the compiled environment.
      level: the level to start from.

    Returns:
      The state, with `sim` as a `PhysicsState`.
    """
    robots, obstacles = level.present.shape[0], level.obstacle_present.shape[0]
    sensors = len(world.robot.sensor_poses)
    factors = task_factors.draw(level.seed, world.realism, robots, obstacles, jnp, sensors)
    clock, arrived = jnp.zeros((), jnp.int32), jnp.zeros(robots, bool)
    goal, target = world.goal.begin(level)
    level = level._replace(target=target)
    sight, _ = _look(world, level.start, level, factors)
    sight = _look_by_extension(world, sight, level.start, level, arrived, clock)
    memory, seen = task_electronics.begin(world.electronics, factors, sight, clock, jnp)
    return EnvState(
        sim=physics.rest(world.physics, level.start),
        level=level,
        factors=factors,
        memory=memory,
        observation=seen,
        clock=clock,
        goal=goal,
        arrived=arrived,
        distance=sight.distance,
        apart=jnp.full((robots, len(sim_gaps.KINDS)), sim_gaps.CONTACT_PAUSE),
        episode=Episode(
            reward=jnp.zeros(robots),
            contacts=jnp.zeros((robots, len(sim_gaps.KINDS)), jnp.int32),
            sensed=jnp.zeros(robots, jnp.int32),
            moving=jnp.zeros(robots, jnp.int32),
        ),
        path=_measure_path(world, level),
    )


def _measure_path(
    world: World, level: Level, before: geodesic.Path | None = None, pose: Array | None = None
) -> geodesic.Path | None:
    """Measures the paths from the starts, or from poses [R, 3]; None if the reward needs none."""
    if not world.task.reward.path_progress:
        return None
    hull, impl = world.robot.hull_radius, world.physics.engine.impl
    fast = dispatch.load_fast("paths_warp", impl)
    if before is None or pose is None:
        return geodesic.begin(level, hull, fast)
    return geodesic.go_on(before, pose[:, :2], level, hull, fast)


def look_around(world: World, state: EnvState) -> Array:
    """Lists the surroundings [R, P] of each robot for a critic, as `surroundings.look` does."""
    pose = physics.poses(world.physics, state.sim)
    to_go, waypoint = state.distance, state.level.target
    if state.path is not None:
        to_go = state.path.distance
        waypoint = geodesic.waypoint(state.path, pose[:, :2], state.level)
    return surroundings.look(pose, state.level, state.arrived, to_go, waypoint)


def step[S: EnvState](world: World, state: S, action: Array) -> tuple[S, TimeStep]:
    """Advances one arena by one control step.

    Args:
      world: the compiled environment.
      state: the arena, with `sim` as the physics' own data. Fields of a subclass of `EnvState`
        pass through unchanged.
      action: [R, U] forward speed and turn rate, clipped to -1..1; -1 and 1 are the ends of each
        command's range.

    Returns:
      The new state, and the outcome of the step.
    """
    chex.assert_shape(action, (state.level.present.shape[0], sim_drive.ACTION_SIZE))
    active = state.level.present & world.goal.drives(state.arrived)
    clock = state.clock + 1
    data, memory, pose, sound = _move(world, state, action, active)
    looked, around = _look(world, pose, state.level, state.factors)  # still at the old targets
    turn, level, sight = _turn(world, state, looked, pose, clock)
    arrived, ends = turn.arrived, world.goal.terminates(state.arrived, turn.arrived, level.present)
    sight = _look_by_extension(world, sight, pose, level, arrived, clock)
    memory, seen = task_electronics.sense(
        world.electronics, memory, state.factors, sight, clock, jnp
    )
    begins, apart = sim_gaps.count_contacts(around.gap, state.apart, world.task.control_step, jnp)
    begins &= level.present[:, None]
    after = replace(
        state,
        sim=data,
        level=level,
        memory=memory,
        clock=clock,
        goal=turn.state,
        arrived=arrived,
        distance=sight.distance,
        apart=apart,
        path=_measure_path(world, level, state.path, pose),
    )
    earns = ends if turn.earns is None else turn.earns
    earned = _reward_step(world, state, after, looked, earns, begins, pose, action)
    gained = reward.total(earned, world.task.reward, world.terms)
    sound &= around.complete & _is_finite(gained, active)
    sound &= _is_finite(sight.distance, level.present) & _is_finite(seen, level.present[:, None])
    valid = active & sound
    gained = jnp.where(valid, gained, 0.0)
    # Learning skips the step of a broken arena, so its observation can be the previous one.
    seen = jnp.where(sound, seen, state.observation)
    counted = valid & world.goal.is_under_way(state.arrived)
    episode = _tally(state.episode, gained, begins, earned, counted)
    timeout = clock >= world.task.step_limit
    return replace(after, observation=seen, episode=episode), TimeStep(
        observation=seen,
        reward=gained,
        terminated=ends,
        truncated=active & ~ends & (timeout | ~sound),
        valid=valid,
        done=world.goal.is_over(arrived, level.present) | timeout | ~sound,
        sound=sound,
        measured=world.goal.measured(turn),
    )


def _turn(
    world: World, state: EnvState, sight: Sight, pose: Array, clock: Array
) -> tuple[Turn, Level, Sight]:
    """Asks the goal; returns its turn, the level with new targets, and their distance in sight."""
    view = task_electronics.view(sight, pose, state.level, state.arrived, clock)
    turn = world.goal.turn(state.goal, state.level, view)
    if not world.goal.moves:
        return turn, state.level, sight
    distance, bearing = observation.to_target(pose, turn.target, jnp)
    sight = sight._replace(distance=distance, bearing=bearing)
    return turn, state.level._replace(target=turn.target), sight


def _reward_step(
    world: World,
    before: EnvState,
    after: EnvState,
    sight: Sight,
    arrives: Array,
    begins: Array,
    pose: Array,
    action: Array,
) -> reward.Step:
    """Assembles the input of the reward terms; `sight` still measures the old targets."""
    step = reward.Step(
        distance_before=before.distance,
        distance=sight.distance,
        infrared=sight.ray,
        sensor_range=world.robot.sensor_range,
        arrives=arrives,
        contact_begins=begins & world.goal.drives(before.arrived)[:, None],
        touching=after.apart == 0.0,
        outside=world.goal.is_under_way(before.arrived),
    )
    if before.path is not None and after.path is not None:
        step = step._replace(path_before=before.path.distance, path=after.path.distance)
    if not world.terms:
        return step
    return step._replace(
        pose_before=physics.poses(world.physics, before.sim),
        pose=pose,
        action=jnp.clip(action, -1.0, 1.0),
        present=before.level.present,
        clock=after.clock,
    )


def _is_finite(numbers: Array, counted: Array) -> Array:
    """Returns [] whether the numbers [R, ...] of all counted robots are finite."""
    return jnp.all(jnp.isfinite(numbers) | ~counted)


def _move(
    world: World, state: EnvState, action: Array, active: Array
) -> tuple[Any, Memory, Array, Array]:
    """Steps the physics; only active robots obey their commands.

    Returns:
      Data, memory, poses, and whether all numbers of the physics are finite.
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
    # A broken arena keeps its last finite poses until it is reset, so other numbers stay finite.
    before, after = (physics.poses(world.physics, each) for each in (state.sim, data))
    return data, memory, jnp.where(sound, after, before), sound


def _look(world: World, pose: Array, level: Level, factors: Factors) -> tuple[Sight, Surround]:
    """Measures what the sensors can see from poses [R, 3]."""
    distance, bearing = observation.to_target(pose, level.target, jnp)
    shades = task_electronics.reflectance(factors)
    scene = senses.Scene(pose, level.side, level.obstacle, factors.infrared_yaw, shades)
    robot, impl = world.robot, world.physics.engine.impl
    around = senses.look(
        scene, robot.sensor_poses, robot.hull_radius, world.electronics.reach, impl
    )
    return Sight(around.ray, around.bright, distance, bearing), around


def _look_by_extension(
    world: World, sight: Sight, pose: Array, level: Level, arrived: Array, clock: Array
) -> Sight:
    """Adds the observations of an extension."""
    if not world.electronics.own:
        return sight
    view = task_electronics.view(sight, pose, level, arrived, clock)
    return sight._replace(own=extended.look(world.electronics.own, view))


def _tally(
    episode: Episode, gained: Array, begins: Array, earned: reward.Step, counted: Array
) -> Episode:
    """Adds a step to the sums; for `sensed` and `moving`, only `counted` robots [R] count."""
    sensed = counted & (reward.proximity(earned) > 0.0)
    return Episode(
        reward=episode.reward + gained,
        contacts=episode.contacts + begins,
        sensed=episode.sensed + sensed,
        moving=episode.moving + counted,
    )
