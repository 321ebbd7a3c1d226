"""Tests one arena's rules: arrival, ends of episodes, rewards, and broken arenas."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from entries import BEARING, DISTANCE, INFRARED, KNOWN

from swarmjax.run.load_settings import load_train
from swarmjax.sim import dispatch, gaps, infrared, neighbours, physics
from swarmjax.task import env, observation
from swarmjax.task import factors as task_factors
from swarmjax.task import stage as task_stage
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.task.level import Level
from swarmjax.task.observation import Readings
from swarmjax.task.world import World
from swarmjax.training import program as programs
from swarmjax.training import rollout
from swarmjax.training.rollout import Arena

ArenaStep = Callable[[EnvState, jax.Array], tuple[EnvState, TimeStep]]

ARENAS, ROBOTS, OBSTACLES, LIMIT = 8, 3, 2, 16  # of the tiny configuration
HULL, REACH, RANGE = 0.037, 0.05, 0.04  # m
METRIC = observation.LAYOUTS["metric"]
PACE = 0.1256 * 0.032  # m per step at full speed: 4.02 mm
AHEAD, STILL = (1.0, 0.0), (-1.0, 0.0)  # actions


class Robot(NamedTuple):
    x: float
    y: float
    yaw: float
    target: tuple[float, float]
    action: tuple[float, float]


class Episode(NamedTuple):
    """Arenas driven for one step limit without a reset: states [T + 1, A] and steps [T, A]."""

    state: EnvState
    came: TimeStep
    pose: np.ndarray
    rate: np.ndarray


# The first robot arrives after 3 steps: it is 60, 56, 52, then 48 mm from its target. The second
# robot's target is behind a wall.
ARRIVES = [Robot(0.0, 0.0, 0.0, (0.06, 0.0), AHEAD), Robot(-0.2, 0.2, 1.0, (9.0, 9.0), STILL)]
# The robots arrive after 3 and 5 steps: the second is 70, 66, 62, 58, 54, then 49.9 mm away.
ALL_ARRIVE = [Robot(0.0, 0.0, 0.0, (0.06, 0.0), AHEAD), Robot(0.0, 0.2, 0.0, (0.07, 0.2), AHEAD)]
# The second robot drives head-on into the first, which has arrived, and pushes it back.
PUSHED = [Robot(0.0, 0.0, 0.0, (0.06, 0.0), AHEAD), Robot(0.11, 0.0, np.pi, (9.0, 9.0), AHEAD)]
# The first robot stands 23 mm from the east wall. Nothing is near the other two robots.
STANDS = [
    Robot(0.34, 0.0, 0.0, (0.0, 0.3), STILL),
    Robot(-0.1, 0.0, 0.0, (-0.3, 0.3), STILL),
    Robot(0.1, -0.25, 0.0, (-0.3, 0.0), STILL),
]
# The first robot drives into the east wall, and the second into an obstacle.
BUMPS = [
    Robot(0.34, 0.0, 0.0, (0.0, 0.3), AHEAD),
    Robot(-0.05, -0.25, np.pi, (0.3, -0.25), AHEAD),
]
OBSTACLE = (-0.2, -0.25, 0.0, 0.05, 0.05)
# The first robot arrives in the very step in which time runs out: its target is 50 mm and 15.5
# steps of driving away.
JUST_IN_TIME = [
    Robot(0.0, 0.0, 0.0, (REACH + 15.5 * PACE, 0.0), AHEAD),
    Robot(0.0, 0.2, 0.0, (9.0, 9.0), STILL),
]
SCENES = [ARRIVES, ALL_ARRIVE, PUSHED, STANDS, BUMPS, JUST_IN_TIME]
ARRIVING, ALL, PUSHING, STANDING, BUMPING, ENDING, *RANDOM = range(ARENAS)


def _level(robots: list[Robot]) -> Level:
    """Returns a level 0.8 m wide with the given robots and one obstacle, the rest parked."""
    parked = [Robot(5.0 + 0.5 * i, 5.0, 0.0, (5.0 + 0.5 * i, 5.0), AHEAD) for i in range(ROBOTS)]
    everyone = [*robots, *parked[len(robots) :]]
    return Level(
        side=np.float32(0.8),
        present=np.arange(ROBOTS) < len(robots),
        start=np.array([robot[:3] for robot in everyone], np.float32),
        target=np.array([robot.target for robot in everyone], np.float32),
        obstacle_present=np.array([True, False]),
        obstacle=np.array([OBSTACLE, (-5.5, -5.0, 0.0, 0.05, 0.05)], np.float32),
        seed=np.uint32(0),
    )


def _crowd(random: np.random.Generator) -> list[Robot]:
    """Returns three robots close to each other; `actions` draws their actions for each step."""
    place = [(-0.05, 0.0), (0.05, 0.0), (0.0, 0.09)]
    return [Robot(x, y, random.uniform(-3, 3), (0.1, 0.06), AHEAD) for x, y in place]


def _start(world: World, levels: list[Level]) -> EnvState:
    stacked = jax.tree.map(lambda *fields: jnp.asarray(np.stack(fields)), *levels)
    state = jax.jit(jax.vmap(functools.partial(env.reset, world)))(stacked)
    sim = jax.vmap(functools.partial(physics.unpack, world.physics))(state.sim)
    return dataclasses.replace(state, sim=sim)


def _slim(state: EnvState) -> EnvState:
    """Returns the state in NumPy, with only those parts of the physics that checkpoints hold."""
    return jax.tree.map(np.asarray, dataclasses.replace(state, sim=physics.pack(state.sim)))


def _stack(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


@pytest.fixture(scope="module")
def actions() -> np.ndarray:
    random = np.random.default_rng(5)
    chosen = random.uniform(-1.5, 1.5, (LIMIT, ARENAS, ROBOTS, 2)).astype(np.float32)
    chosen[..., 0] += 0.5
    for arena, robots in enumerate(SCENES):
        for i in range(ROBOTS):
            chosen[:, arena, i] = robots[i].action if i < len(robots) else AHEAD
    return chosen


@pytest.fixture(scope="module")
def start(tiny_world: World) -> EnvState:
    random = np.random.default_rng(6)
    return _start(tiny_world, [_level(r) for r in [*SCENES, *(_crowd(random) for _ in RANDOM)]])


@pytest.fixture(scope="module")
def episode(start: EnvState, actions: np.ndarray, tiny_step: ArenaStep) -> Episode:
    state, states, steps = start, [_slim(start)], []
    for action in actions:
        state, came = tiny_step(state, jnp.asarray(action))
        states.append(_slim(state))
        steps.append(jax.tree.map(np.asarray, came))
    stacked = _stack(states)
    shape = (LIMIT + 1, ARENAS, ROBOTS, 3)
    return Episode(
        stacked,
        _stack(steps),
        stacked.sim.qpos.reshape(shape).astype(np.float64),
        stacked.sim.qvel.reshape(shape),
    )


# --- arrival


def test_a_robot_arrives_once_and_its_own_episode_ends(episode: Episode) -> None:
    came = episode.came
    robot = ARRIVING, 0
    assert came.terminated[:, *robot].tolist() == [t == 2 for t in range(LIMIT)]
    assert episode.state.arrived[:, *robot].tolist() == [t >= 3 for t in range(LIMIT + 1)]
    assert came.valid[:, *robot].tolist() == [t <= 2 for t in range(LIMIT)]
    assert not came.reward[3:, *robot].any()
    assert not came.truncated[:, *robot].any()
    # The distance is 60 mm less three steps; 1e-6 m covers float32.
    assert episode.state.distance[3, *robot] == pytest.approx(0.06 - 3 * PACE, abs=1e-6)


def test_a_robot_that_has_arrived_stands_whatever_its_action(episode: Episode) -> None:
    rate = episode.rate[:, ARRIVING, 0]
    # It drives until it arrives, then stops at once, since its servo is deadbeat. 1e-6: float32.
    np.testing.assert_allclose(rate[1:4, 0], 0.1256, atol=1e-6)
    np.testing.assert_allclose(rate[4:], 0.0, atol=1e-6)
    place = episode.pose[:, ARRIVING, 0]
    np.testing.assert_allclose(place[4:], np.broadcast_to(place[3], (13, 3)), atol=1e-6)


def test_a_robot_that_is_pushed_away_has_still_arrived(episode: Episode) -> None:
    robot = PUSHING, 0
    assert episode.came.terminated[:, *robot].tolist() == [t == 2 for t in range(LIMIT)]
    assert episode.state.distance[-1, *robot] > REACH + 0.01  # pushed out by over a centimetre
    assert episode.state.arrived[3:, *robot].all()
    assert not episode.came.valid[3:, *robot].any()
    assert not episode.came.reward[3:, *robot].any()


def test_all_arrived_ends_the_episode(episode: Episode) -> None:
    assert np.flatnonzero(episode.came.terminated[:, ALL, 0]).tolist() == [2]
    assert np.flatnonzero(episode.came.terminated[:, ALL, 1]).tolist() == [4]
    assert np.flatnonzero(episode.came.done[:, ALL])[0] == 4
    assert not episode.came.truncated[:5, ALL].any()


# --- the end of time


def test_time_runs_out_for_those_on_their_way(episode: Episode) -> None:
    came = episode.came
    assert not came.truncated[:-1].any()
    on_their_way = episode.state.level.present[0] & ~episode.state.arrived[-1]
    np.testing.assert_array_equal(came.truncated[-1], on_their_way)
    assert on_their_way[ARRIVING].tolist() == [False, True, False]
    assert came.done[-1].all()
    assert not came.done[:-1, [ARRIVING, PUSHING, STANDING, BUMPING]].any()
    assert episode.state.clock[:, 0].tolist() == list(range(LIMIT + 1))


def test_arrival_in_the_last_step_is_no_timeout(episode: Episode) -> None:
    assert np.flatnonzero(episode.came.terminated[:, ENDING, 0]).tolist() == [LIMIT - 1]
    assert episode.came.truncated[-1, ENDING].tolist() == [False, True, False]


def test_no_robot_terminates_twice_nor_ends_both_ways(episode: Episode) -> None:
    assert (episode.came.terminated.sum(axis=0) <= 1).all()
    assert not (episode.came.terminated & episode.came.truncated).any()
    assert episode.came.terminated.sum() == episode.state.arrived[-1].sum()


def test_absent_robots_take_no_part(episode: Episode) -> None:
    absent = ~episode.state.level.present[0]
    assert absent.sum() == 5
    for name in ("valid", "terminated", "truncated", "reward"):
        assert not getattr(episode.came, name)[:, absent].any(), name
    for total in episode.state.episode:
        assert not total[-1][absent].any()
    # Actions do not move absent robots from where they are parked.
    np.testing.assert_array_equal(
        episode.pose[:, absent], np.broadcast_to(episode.pose[0][absent], (LIMIT + 1, 5, 3))
    )


# --- observation


def test_observation_is_of_the_state_after_the_step_before_any_reset(episode: Episode) -> None:
    level = episode.state.level
    for t in range(LIMIT):
        for a in range(ARENAS):
            pose = episode.pose[t + 1, a].astype(np.float32)
            side, box, target = level.side[0, a], level.obstacle[0, a], level.target[0, a]
            seen = infrared.distances(pose, side, box, HULL, RANGE, np)
            distance, bearing = observation.to_target(pose, target, np)
            expected = observation.observe(Readings(seen, distance, bearing), METRIC, np)
            found = episode.came.observation[t, a]
            # 1e-5 m covers float32 rounding, which a glancing ray multiplies.
            rest = KNOWN[KNOWN != BEARING]
            np.testing.assert_allclose(found[:, rest], expected[:, rest], atol=1e-5)
            # Bearings are compared on the unit circle, since half a turn may have either sign. An
            # absent robot stands on its target, where rounding decides the bearing.
            turn = np.abs(np.exp(1j * found[:, BEARING]) - np.exp(1j * expected[:, BEARING]))
            present = level.present[0, a]
            assert (turn < 1e-5)[present].all()


def test_first_observation(tiny_world: World, start: EnvState) -> None:
    level = jax.tree.map(np.asarray, start.level)
    state = env.reset(tiny_world, jax.tree.map(lambda x: x[STANDING], start.level))
    found = state.observation
    expected = infrared.distances(
        level.start[STANDING], level.side[STANDING], level.obstacle[STANDING], HULL, RANGE, np
    )
    np.testing.assert_allclose(found[:, INFRARED], expected, atol=1e-6)  # float32
    # The first robot faces the wall, 60 mm ahead of its centre. Its ps7 and ps0 sit 30 mm ahead;
    # ps7 looks 0.2992 rad to the left, and ps0 looks 0.30081 rad to the right.
    assert found[0, INFRARED][7] == pytest.approx(0.03 / np.cos(0.2992), abs=1e-6)
    assert found[0, INFRARED][0] == pytest.approx(0.03 / np.cos(0.30081), abs=1e-6)
    # The first robot's target is 0.34 m behind it and 0.3 m to the left.
    assert found[0, DISTANCE] == pytest.approx(np.hypot(0.34, 0.3), abs=1e-6)
    assert found[0, BEARING] == pytest.approx(np.arctan2(0.3, -0.34), abs=1e-6)
    assert int(state.clock) == 0
    np.testing.assert_array_equal(state.distance, found[:, DISTANCE])
    assert not state.arrived.any()


# --- reward and counts


def test_a_robot_that_stands_in_range_pays_every_step_once(episode: Episode) -> None:
    # Two rays of the first robot see the wall; the other robots see nothing.
    assert (episode.came.observation[:, STANDING, 0, INFRARED] < RANGE).sum(axis=-1).min() == 2
    expected = np.broadcast_to(np.float32([-0.001, 0.0, 0.0]), (LIMIT, ROBOTS))
    # 1e-7 m covers rounding: the distance to the target is recomputed at every step.
    np.testing.assert_allclose(episode.came.reward[:, STANDING], expected, atol=1e-7)
    assert episode.state.episode.sensed[-1, STANDING].tolist() == [LIMIT, 0, 0]


def test_rewards_of_an_episode_add_up_to_the_way_made(episode: Episode) -> None:
    """Progress rewards telescope; each step with something in range costs a further 0.001."""
    present = episode.state.level.present[0]
    ended = np.where(
        episode.came.terminated.any(axis=0), episode.came.terminated.argmax(axis=0), 15
    )
    last = np.take_along_axis(episode.state.distance[1:], ended[None], axis=0)[0]
    progress = episode.state.distance[0] - last
    sensed = episode.came.observation[..., INFRARED].min(axis=-1) < RANGE
    steps = np.sum(sensed & episode.came.valid, axis=0)
    expected = np.where(present, progress - 0.001 * steps, 0.0)
    assert (steps[RANDOM] > 0).any()
    # 1e-6 covers sixteen sums in float32.
    np.testing.assert_allclose(episode.came.reward.sum(axis=0), expected, atol=1e-6)
    np.testing.assert_allclose(episode.state.episode.reward[-1], expected, atol=1e-6)
    np.testing.assert_array_equal(episode.state.episode.sensed[-1], np.where(present, steps, 0))


def test_steps_before_arrival_are_counted(episode: Episode) -> None:
    moving = episode.state.episode.moving[-1]
    np.testing.assert_array_equal(moving, episode.came.valid.sum(axis=0))
    assert moving[ARRIVING].tolist() == [3, LIMIT, 0]
    assert moving[ALL].tolist() == [3, 5, 0]


def test_contacts_are_counted_by_kind(episode: Episode) -> None:
    counts = episode.state.episode.contacts[-1]
    assert gaps.KINDS == ("robot", "obstacle", "wall")
    # One robot meets a wall 23 mm ahead, and another an obstacle. Each contact counts once,
    # although the robots keep pushing.
    assert counts[BUMPING].tolist() == [[0, 0, 1], [0, 1, 0], [0, 0, 0]]
    # A contact of two robots counts once for each of them, even for one that has arrived.
    assert counts[PUSHING].tolist() == [[1, 0, 0], [1, 0, 0], [0, 0, 0]]
    assert not counts[STANDING].any()
    # The poses must give the same counts.
    apart = np.full((ARENAS, ROBOTS, 3), gaps.CONTACT_PAUSE)
    expected = np.zeros((ARENAS, ROBOTS, 3), int)
    level = jax.tree.map(lambda field: field[0], episode.state.level)
    for pose in episode.pose[1:]:
        gap = [
            gaps.gaps(pose[a], level.side[a], level.obstacle[a], HULL, np) for a in range(ARENAS)
        ]
        begins, apart = gaps.count_contacts(np.stack(gap), apart, 0.032, np)
        expected += begins & level.present[..., None]
    np.testing.assert_array_equal(counts, expected)
    assert expected[RANDOM].sum() >= 3


def _priced(
    world: World, start: EnvState, actions: np.ndarray, arena: int, **weights: float
) -> env.TimeStep:
    """Drives one arena again with other reward weights, and returns its steps."""
    task = world.task
    priced = dataclasses.replace(task, reward=dataclasses.replace(task.reward, **weights))
    step = functools.partial(env.step, dataclasses.replace(world, task=priced))
    state = jax.tree.map(lambda x: x[arena], start)
    drive = jax.jit(lambda state, chosen: jax.lax.scan(step, state, chosen))
    return drive(state, jnp.asarray(actions[:, arena]))[1]


def test_leaning_is_charged_in_every_step(
    tiny_world: World, start: EnvState, actions: np.ndarray, episode: Episode
) -> None:
    came = _priced(tiny_world, start, actions, BUMPING, touching=-0.5)
    side, obstacle = (np.asarray(x[BUMPING]) for x in (start.level.side, start.level.obstacle))
    gap = np.stack(
        [gaps.gaps(pose, side, obstacle, HULL, np) for pose in episode.pose[1:, BUMPING]]
    )
    leans = (gap <= 0.0).any(axis=-1) & np.asarray(came.valid)
    assert leans.sum(axis=0)[0] > 5, "it keeps pushing"
    charged = np.asarray(came.reward) - episode.came.reward[:, BUMPING]
    # 1e-5 covers the rounding of another program, which contacts multiply.
    np.testing.assert_allclose(charged, -0.5 * leans, atol=1e-5)


# --- one arena and the others


@pytest.mark.parametrize("arena", [PUSHING, RANDOM[0]])
def test_an_arena_moves_as_it_would_in_any_other_company(
    start: EnvState, actions: np.ndarray, episode: Episode, tiny_step: ArenaStep, arena: int
) -> None:
    # Eight copies of one arena, run by the same program, repeat bit for bit what the arena did
    # among other arenas.
    state = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[arena], leaf.shape), start)
    for t, action in enumerate(actions):
        mine = np.broadcast_to(action[arena], action.shape)
        state, came = tiny_step(state, jnp.asarray(mine))
        expected = jax.tree.map(lambda leaf, t=t: leaf[t, arena], episode.came)
        for found, one in zip(came, expected, strict=True):
            np.testing.assert_array_equal(found, np.broadcast_to(one, found.shape))
        qpos = episode.state.sim.qpos[t + 1, arena]
        np.testing.assert_array_equal(state.sim.qpos, np.broadcast_to(qpos, state.sim.qpos.shape))
    assert episode.state.episode.contacts[-1, arena].any(), "it has touched something"


@pytest.mark.parametrize("field", ["qpos", "qvel", "qacc_warmstart"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_broken_arena_leaves_its_neighbours_alone(
    start: EnvState, actions: np.ndarray, tiny_step: ArenaStep, field: str, value: float
) -> None:
    spoilt = {field: getattr(start.sim, field).at[BUMPING, 0].set(value)}
    broken = dataclasses.replace(start, sim=start.sim.replace(**spoilt))
    sound = start
    others = np.arange(ARENAS) != BUMPING
    for action in actions[:3]:
        sound, expected = tiny_step(sound, jnp.asarray(action))
        broken, found = tiny_step(broken, jnp.asarray(action))
        jax.tree.map(
            lambda theirs, mine: np.testing.assert_array_equal(theirs[others], mine[others]),
            (_slim(broken), found),
            (_slim(sound), expected),
        )


def test_a_broken_arena_is_over_and_teaches_nothing(
    start: EnvState, actions: np.ndarray, tiny_step: ArenaStep
) -> None:
    state, _ = tiny_step(start, jnp.asarray(actions[0]))
    before = state.distance[BUMPING]
    spoilt = state.sim.replace(qvel=state.sim.qvel.at[BUMPING, 4].set(jnp.nan))
    state = dataclasses.replace(state, sim=spoilt)
    state, came = jax.tree.map(np.asarray, tiny_step(state, jnp.asarray(actions[1])))
    assert came.sound.tolist() == [a != BUMPING for a in range(ARENAS)]
    assert came.done.tolist() == [a == BUMPING for a in range(ARENAS)]
    assert not came.valid[BUMPING].any()
    assert not came.terminated[BUMPING].any()
    assert came.truncated[BUMPING].tolist() == [True, True, False]
    assert not came.reward[BUMPING].any()
    assert np.isfinite(came.observation).all()
    np.testing.assert_array_equal(state.distance[BUMPING], before)  # it keeps its last distance
    for total in state.episode:
        assert np.isfinite(total).all()


def _spoil(state: EnvState, field: str, value: float) -> EnvState:
    """Sets the last distance or the target of the first robot in one arena to a value."""
    if field == "target":
        level = state.level._replace(target=state.level.target.at[BUMPING, 0, 1].set(value))
        return dataclasses.replace(state, level=level)
    return dataclasses.replace(state, distance=state.distance.at[BUMPING, 0].set(value))


@pytest.mark.parametrize("field", ["distance", "target"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_arena_breaks_by_what_is_seen_and_earned_as_well(
    start: EnvState, actions: np.ndarray, tiny_step: ArenaStep, field: str, value: float
) -> None:
    sound, expected = tiny_step(start, jnp.asarray(actions[0]))
    broken, came = tiny_step(_spoil(start, field, value), jnp.asarray(actions[0]))
    broken, came = jax.tree.map(np.asarray, (_slim(broken), came))
    assert came.sound.tolist() == [a != BUMPING for a in range(ARENAS)]
    assert came.done.tolist() == [a == BUMPING for a in range(ARENAS)]
    assert not came.valid[BUMPING].any()
    assert came.truncated[BUMPING].tolist() == [True, True, False]
    assert np.isfinite(came.reward).all()
    assert np.isfinite(broken.episode.reward).all()
    # The broken arena keeps its last observation.
    np.testing.assert_array_equal(came.observation[BUMPING], start.observation[BUMPING])
    others = np.arange(ARENAS) != BUMPING
    jax.tree.map(
        lambda theirs, mine: np.testing.assert_array_equal(theirs[others], mine[others]),
        (broken, came),
        (_slim(sound), expected),
    )


def _step_in_cells(monkeypatch: pytest.MonkeyPatch, world: World) -> ArenaStep:
    """Returns the control step of a swarm that is large enough to look for others in cells."""
    monkeypatch.setattr(dispatch, "has_cells", lambda robots, listed: True)
    return jax.jit(jax.vmap(functools.partial(env.step, world)))


def test_a_large_swarm_senses_and_touches_what_a_small_one_does(
    monkeypatch: pytest.MonkeyPatch,
    tiny_world: World,
    start: EnvState,
    actions: np.ndarray,
    episode: Episode,
) -> None:
    step, state = _step_in_cells(monkeypatch, tiny_world), start
    for i, action in enumerate(actions):
        state, came = step(state, jnp.asarray(action))
        np.testing.assert_allclose(came.observation, episode.came.observation[i], atol=1e-6)
        np.testing.assert_array_equal(came.valid, episode.came.valid[i])
    np.testing.assert_array_equal(state.episode.contacts, episode.state.episode.contacts[-1])
    assert np.any(state.episode.contacts)


def test_an_arena_with_more_robots_in_a_place_than_fit_is_broken(
    monkeypatch: pytest.MonkeyPatch, tiny_world: World, start: EnvState, actions: np.ndarray
) -> None:
    monkeypatch.setattr(neighbours, "room", lambda hull_radius, limit: 1)
    came = _step_in_cells(monkeypatch, tiny_world)(start, jnp.asarray(actions[0]))[1]
    crowds = np.array(RANDOM)
    assert not came.sound[crowds].any()
    assert came.done[crowds].all()
    assert not came.valid[crowds].any()
    assert came.sound[np.array([STANDING, BUMPING])].all()  # no two robots are near


def test_what_an_absent_robot_sees_breaks_nothing(
    start: EnvState, actions: np.ndarray, tiny_step: ArenaStep
) -> None:
    absent = start.observation.at[BUMPING, 2].set(np.nan)
    state, came = tiny_step(dataclasses.replace(start, observation=absent), jnp.asarray(actions[0]))
    expected, _ = tiny_step(start, jnp.asarray(actions[0]))
    assert came.sound.all()
    jax.tree.map(np.testing.assert_array_equal, _slim(state), _slim(expected))


# --- realism


class Drawn(NamedTuple):
    """Arenas of realistic robots, a program that steps and restarts them, and its traces."""

    world: World
    start: Arena
    step: Callable[[Arena, jax.Array], tuple[Arena, TimeStep]]
    traces: list[Any]


FEW, LIFE = 4, 40  # arenas, and control steps of an episode


@pytest.fixture(scope="module")
def real() -> Drawn:
    """Returns arenas of two robots and one obstacle, with all factors of `realism=real`."""
    arena = ["stage=s2", "stage.obstacles=1", "sim.max_robots=3", "sim.max_obstacles=1"]
    size = [f"arenas={FEW}", f"task.step_limit={LIFE}", "algo.num_minibatches=2", "budget=1000000"]
    config = load_train([*arena, *size, "realism=real", "sim.impl=jax"])
    world, stages = programs.load_world(config), task_stage.stack(config.stage)
    draw = jax.jit(
        functools.partial(rollout.draw_starts, world, stages, jnp.zeros((1, FEW), jnp.int32))
    )
    starts = [draw(jnp.int32(cohort), jax.random.key(cohort)) for cohort in range(2)]
    traces = []

    def step(state: Arena, action: jax.Array) -> tuple[Arena, TimeStep]:
        traces.append(jax.tree.structure(state))
        state, came = jax.vmap(functools.partial(env.step, world))(state, action)
        return rollout.restart(state, starts[1], came.done), came

    sim = jax.vmap(functools.partial(physics.unpack, world.physics))(starts[0].sim)
    return Drawn(world, dataclasses.replace(starts[0], sim=sim), jax.jit(step), traces)


@pytest.mark.slow
def test_real_robots_drive_for_many_episodes(real: Drawn) -> None:
    random, state, ended, cohorts = np.random.default_rng(0), real.start, [], []
    before = jax.tree.structure(state)
    kinds = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), state)
    for _ in range(200):
        action = random.uniform(-1.0, 1.0, (FEW, 3, 2)).astype(np.float32)
        state, came = real.step(state, jnp.asarray(action))
        ended.append(np.asarray(came.done))
        cohorts.append(np.asarray(state.cohort))
        assert np.asarray(came.sound).all()
        for leaf in jax.tree.leaves((_slim(state), came)):
            assert np.isfinite(leaf).all()
    # JAX traces once: each None stays None, and each array keeps its shape and dtype.
    assert real.traces == [before]
    assert jax.tree.structure(state) == before
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), state) == kinds
    # An episode ends after 40 steps, or earlier when all robots have arrived.
    assert (np.sum(ended, axis=0) >= 200 // LIFE).all()
    assert (cohorts[0] == 0).all()
    assert (cohorts[-1] == 1).all()


def test_a_restarted_arena_has_the_robots_of_its_new_episode(real: Drawn) -> None:
    state = dataclasses.replace(real.start, clock=jnp.array([0, LIFE - 1, 0, LIFE - 1], jnp.int32))
    action = jnp.ones((FEW, 3, 2))
    after, came = real.step(state, action)
    assert came.done.tolist() == [False, True, False, True]
    assert after.clock.tolist() == [1, 0, 1, 0]
    new = np.asarray(came.done)
    np.testing.assert_array_equal(after.level.seed != state.level.seed, new)
    np.testing.assert_array_equal(after.cohort, new)  # waiting levels are of cohort 1
    seeds, world = np.asarray(after.level.seed), real.world
    expected = task_factors.draw(seeds, world.realism, 3, 1, np)
    for found, mine in zip(after.factors, expected, strict=True):
        assert found is not None
        assert mine is not None
        # The tolerance covers the rounding of low + u * (high - low), and of log and cos.
        np.testing.assert_allclose(found, mine, rtol=2e-6, atol=1e-6)
    # Nothing of the old episode is left: no command is queued, and the stored observations are the
    # current one.
    commands, infrared, seen = jax.tree.map(np.asarray, after.memory)
    assert commands[~new, 0].all()
    assert not commands[new].any()
    np.testing.assert_array_equal(seen[new, 0], after.observation[new])
    np.testing.assert_array_equal(infrared[new], after.observation[new][..., INFRARED])
