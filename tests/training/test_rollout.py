"""Checks a rollout against a replay in single steps, and the layouts that the learners see."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from entries import DISTANCE, INFRARED

from swarmjax.curriculum.engine import UNCOUNTED
from swarmjax.ppo import batch
from swarmjax.ppo.batch import Batch, Trajectory
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.memory import NO_MEMORY
from swarmjax.ppo.ppo import LearnerState
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import gaps, physics
from swarmjax.task import env, observation
from swarmjax.task import stage as task_stage
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.task.episode import Ended
from swarmjax.task.level import Level
from swarmjax.task.world import World
from swarmjax.training import program as programs
from swarmjax.training import rollout
from swarmjax.training.rollout import Arena, Program

ArenaStep = Callable[[Arena, jax.Array], tuple[Arena, TimeStep]]
Draw = Callable[[int, int], Arena]

T, ARENAS, ROBOTS, LIMIT = 8, 8, 3, 16  # of the tiny configuration
HULL, RANGE = 0.037, 0.04  # m
ARRIVES, BUMPS, BROKEN = 1, 2, 7  # arenas
CLOCK = [0, 0, 9, 10, 11, 12, 13, 0]  # control steps at the start; an episode ends at 16
NOW, NEXT = 4, 5  # cohorts of the running and of the waiting episodes


class Run(NamedTuple):
    """A rollout, with its inputs and its results."""

    learners: LearnerState
    before: Arena
    starts: Arena
    after: Arena
    trajectory: Trajectory
    ended: Ended


class Replay(NamedTuple):
    """The results of the same actions, from single compiled steps: [T, A, ...]."""

    came: TimeStep
    seen: np.ndarray  # what was observed before each step
    pose: np.ndarray  # after each step, before any reset
    fresh: np.ndarray  # whether the next step is the first of an episode
    last: Arena


@pytest.fixture(scope="module")
def program(tiny_config: TrainConfig, tiny_world: World) -> Program:
    return programs.build(tiny_config, tiny_world)


@pytest.fixture(scope="module")
def learners(program: Program) -> LearnerState:
    return jax.vmap(program.ppo.init)(jax.random.split(jax.random.key(1), 1))


@pytest.fixture(scope="module")
def draw(tiny_config: TrainConfig, tiny_world: World) -> Draw:
    """Returns a function of a seed and a cohort that draws starts of the two stages in turn."""
    stages, index = task_stage.stack(tiny_config.stage), jnp.arange(ARENAS)[None] % 2
    draw = jax.jit(functools.partial(rollout.draw_starts, tiny_world, stages, index))
    return lambda seed, cohort: draw(jnp.int32(cohort), jax.random.key(seed))


@pytest.fixture(scope="module")
def before(tiny_world: World, draw: Draw) -> Arena:
    """Returns arenas in the middle of their episodes.

    In one arena all robots arrive, in one a robot drives into a wall, and in one a robot has an
    infinite velocity.
    """
    drawn = draw(0, NOW)
    pose, target = drawn.level.start[ARRIVES], drawn.level.target
    toward = jnp.stack([jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])], axis=-1)
    target = target.at[ARRIVES].set(pose[:, :2] + 0.053 * toward)
    at_wall = jnp.array([0.25 - HULL - 0.001, 0.0, 0.0])
    start = drawn.level.start.at[BUMPS, 0].set(at_wall)
    level = drawn.level._replace(start=start, target=target)
    reset = jax.jit(jax.vmap(functools.partial(env.reset, tiny_world)))
    state = Arena(**vars(reset(level)), stage=drawn.stage, cohort=drawn.cohort)
    sim = state.sim._replace(qvel=state.sim.qvel.at[BROKEN, 1].set(jnp.inf))
    return dataclasses.replace(state, sim=sim, clock=jnp.array(CLOCK, jnp.int32))


@pytest.fixture(scope="module")
def run(program: Program, draw: Draw, learners: LearnerState, before: Arena) -> Run:
    starts = draw(1, NEXT)
    collect = jax.jit(functools.partial(rollout.collect, program))
    found = collect(learners, before, starts, jax.random.key(2))
    again = collect(learners, before, starts, jax.random.key(2))
    other = collect(learners, before, starts, jax.random.key(3))
    jax.tree.map(np.testing.assert_array_equal, again, found)  # bit for bit
    assert (np.asarray(other[1].action) != np.asarray(found[1].action)).all()
    return Run(learners, before, starts, *jax.tree.map(np.asarray, found))


def _unpack[S: EnvState](world: World, state: S) -> S:
    sim = jax.vmap(functools.partial(physics.unpack, world.physics))(state.sim)
    return dataclasses.replace(state, sim=sim)


def _where(done: jax.Array, yes: jax.Array, no: jax.Array) -> jax.Array:
    return jnp.where(done.reshape(-1, *[1] * (no.ndim - 1)), yes, no)


@pytest.fixture(scope="module")
def replay(tiny_world: World, run: Run, tiny_step: ArenaStep) -> Replay:
    state, waiting = _unpack(tiny_world, run.before), _unpack(tiny_world, run.starts)
    rows = []
    for action in run.trajectory.action[:, 0]:  # one learner
        seen = state.observation
        state, came = tiny_step(state, jnp.asarray(action))
        pose = jax.vmap(functools.partial(physics.poses, tiny_world.physics))(state.sim)
        rows.append((came, seen, pose, came.done))
        # A waiting episode begins with its whole state, and not only with the packed part.
        state = jax.tree.map(functools.partial(_where, came.done), waiting, state)
    came, observed, pose, fresh = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    return Replay(came, observed, pose, fresh, state)


def _values(program: Program, learners: LearnerState, seen: np.ndarray) -> np.ndarray:
    """Returns the values [..., A, R] of the only learner."""
    one = jax.tree.map(lambda leaf: leaf[0], learners)
    return np.asarray(program.ppo.value(one, jnp.asarray(seen))[0])


def _samples(trajectory: Trajectory, config: AlgoConfig) -> Batch:
    """Returns the samples [L] of a trajectory [T, L, A, N, ...] in which no episode ended."""
    over = jnp.zeros((trajectory.valid.shape[0], trajectory.valid.shape[2]), bool)

    def one(mine: Trajectory) -> Batch:
        return batch.make(mine, NO_MEMORY, over, config)

    return jax.vmap(one, in_axes=1)(trajectory)


def _at[Tree](tree: Tree, where: Any) -> Tree:
    """Indexes all leaves, for example by a step or an arena."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[where], tree)


# --- layouts


def test_one_learner_drives_all_robots() -> None:
    x = jnp.arange(4 * 3 * 2).reshape(4, 3, 2)
    mine = rollout.to_learners(x, 1)
    assert mine.shape == (1, 4, 3, 2)
    assert mine[0, 2, 1, 0] == x[2, 1, 0]
    np.testing.assert_array_equal(rollout.to_arenas(mine), x)


def test_each_robot_has_its_learner() -> None:
    x = jnp.arange(4 * 3 * 2).reshape(4, 3, 2)
    mine = rollout.to_learners(x, 3)
    assert mine.shape == (3, 4, 1, 2)
    assert mine[1, 2, 0, 0] == x[2, 1, 0]
    np.testing.assert_array_equal(rollout.to_arenas(mine), x)
    flat = rollout.to_learners(x[..., 0], 3)  # without features
    assert flat.shape == (3, 4, 1)
    np.testing.assert_array_equal(rollout.to_arenas(flat), x[..., 0])


def _random_trajectory(shape: tuple[int, int, int, int]) -> Trajectory:
    """Returns random numbers [T, L, A, N, ...], with ends of both kinds and invalid samples."""
    random = np.random.default_rng(0)
    end = random.random(shape)
    trajectory = Trajectory(
        observation=random.random((*shape, observation.SIZE)),
        action=random.random((*shape, 2)),
        log_prob=random.random(shape),
        value=random.random(shape),
        next_value=random.random(shape),
        reward=random.random(shape),
        terminated=end < 0.2,
        truncated=end > 0.8,
        valid=random.random(shape) < 0.7,
    )
    return jax.tree.map(jnp.asarray, trajectory)


@pytest.mark.parametrize(("count", "robots"), [(1, 3), (3, 1)])
def test_batch_groups_the_samples_of_an_arena(count: int, robots: int) -> None:
    shape = (5, count, 4, robots)
    trajectory = _random_trajectory(shape)
    advantage, return_ = batch.generalized_advantages(
        *trajectory[5:6],
        *trajectory[3:5],
        *trajectory[6:8],
        discount=0.9,
        gae_lambda=0.8,
    )
    found = _samples(trajectory, AlgoConfig(discount=0.9, gae_lambda=0.8))
    for t, learner, arena, robot in np.ndindex(*shape):
        mine, sample = (learner, arena, t * robots + robot), (t, learner, arena, robot)
        np.testing.assert_array_equal(found.observation[mine], trajectory.observation[sample])
        np.testing.assert_array_equal(found.action[mine], trajectory.action[sample])
        assert found.log_prob[mine] == trajectory.log_prob[sample]
        assert found.valid[mine] == trajectory.valid[sample]
        assert found.advantage[mine] == advantage[sample]
        assert found.return_[mine] == return_[sample]
    assert found.valid.shape == (count, 4, 5 * robots)


def test_monte_carlo_returns_are_targets_and_advantages() -> None:
    shape = (20, 2, 3, 1)
    trajectory = _random_trajectory(shape)
    config = AlgoConfig(discount=0.9, advantage="monte_carlo")
    found = _samples(trajectory, config)
    reward, terminated, truncated, valid = (np.asarray(x) for x in trajectory[5:9])
    following, returns = np.zeros(shape[1:]), np.zeros(shape)
    for t in reversed(range(shape[0])):
        following = reward[t] + 0.9 * np.where(terminated[t] | truncated[t], 0.0, following)
        returns[t] = following
    for learner in range(2):  # each normalises over its own samples
        mine = np.s_[:, learner, :, 0]
        inside = returns[mine][valid[mine]]
        normal = (returns[mine] - inside.mean()) / (inside.std(ddof=1) + 1e-7)
        # float32 sums of up to ten rewards of order 1.
        np.testing.assert_allclose(found.return_[learner], normal.T, atol=5e-6)
        advantage = normal - np.asarray(trajectory.value[mine])
        np.testing.assert_allclose(found.advantage[learner], advantage.T, atol=5e-6)


# --- episodes that wait


def test_starts_are_of_the_stage_they_are_asked_for(draw: Draw) -> None:
    state = draw(3, NEXT)
    assert state.stage.tolist() == [0, 1] * 4
    assert state.cohort.tolist() == [NEXT] * ARENAS
    # The first stage has 2 robots in 0.5 m. The second has 3 robots and 2 obstacles in 0.8 m.
    assert state.level.present.sum(axis=-1).tolist() == [2, 3] * 4
    assert state.level.obstacle_present.sum(axis=-1).tolist() == [0, 2] * 4
    np.testing.assert_array_equal(state.level.side, np.float32([0.5, 0.8] * 4))
    places = np.asarray(state.level.start[:, 0, :2])
    assert len(np.unique(places, axis=0)) == ARENAS
    pose = np.asarray(state.sim.qpos).reshape(ARENAS, ROBOTS, 3)
    np.testing.assert_array_equal(pose, state.level.start)
    assert not state.sim.qvel.any()
    jax.tree.map(np.testing.assert_array_equal, draw(3, NEXT), state)


def test_restart_puts_the_waiting_episode_into_arenas_that_are_over(
    tiny_world: World, run: Run
) -> None:
    running = _unpack(tiny_world, run.before)
    done = jnp.arange(ARENAS) % 3 == 0
    found = rollout.restart(running, run.starts, done)
    packed = dataclasses.replace(found, sim=physics.pack(found.sim))

    def check(mine: jax.Array, waiting: jax.Array, before: jax.Array) -> None:
        for arena in range(ARENAS):
            expected = waiting if arena in (0, 3, 6) else before
            np.testing.assert_array_equal(mine[arena], expected[arena])

    jax.tree.map(check, packed, run.starts, run.before)


# --- numbers that are not finite


SPOILT = 3  # arena
Collect = Callable[[Arena], tuple[Arena, Trajectory, Ended]]


@pytest.fixture(scope="module")
def collect(program: Program, draw: Draw, learners: LearnerState) -> Collect:
    """Returns a function that runs one rollout of given arenas."""
    found = jax.jit(functools.partial(rollout.collect, program))
    return lambda arenas: jax.tree.map(
        np.asarray, found(learners, arenas, draw(1, NEXT), jax.random.key(2))
    )


def _spoil(arenas: Arena, field: str, value: float) -> Arena:
    """Returns arenas in which this field of one robot has this value."""
    if field in ("qpos", "qvel"):
        sim = arenas.sim._replace(**{field: getattr(arenas.sim, field).at[SPOILT, 1].set(value)})
        return dataclasses.replace(arenas, sim=sim)
    return dataclasses.replace(arenas, distance=arenas.distance.at[SPOILT, 1].set(value))


@pytest.mark.parametrize("field", ["qpos", "qvel", "distance"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_arena_that_is_not_finite_is_left_out_counted_and_begun_anew(
    program: Program, draw: Draw, collect: Collect, field: str, value: float
) -> None:
    begun = draw(0, NOW)
    sound, broken = collect(begun), collect(_spoil(begun, field, value))
    after, trajectory, ended = broken
    # The arena breaks once, in the first step, and its later samples are valid.
    assert ended.broken.sum(axis=1).tolist() == [1] + [0] * (T - 1)
    assert ended.broken[0, SPOILT] == 1
    assert not trajectory.valid[0, 0, SPOILT].any()
    assert trajectory.valid[1:, 0, SPOILT, :2].all()
    assert after.cohort[SPOILT] == NEXT
    assert np.isfinite(ended.reward).all()
    for leaf in jax.tree.leaves((after.sim, after.observation, after.distance, after.episode)):
        assert np.isfinite(leaf).all()
    # The other arenas do not change.
    others = np.arange(ARENAS) != SPOILT
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[others], b[others]), after, sound[0])
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a[:, :, others], b[:, :, others]),
        trajectory,
        sound[1],
    )
    # All samples that the learners use are finite.
    samples = _samples(jax.tree.map(jnp.asarray, trajectory), program.config.algo)
    valid = np.asarray(samples.valid)
    for x in jax.tree.leaves(samples):
        assert np.isfinite(np.asarray(x)[valid]).all()


# --- the rollout against its replay

# XLA fuses the scan and the single step differently, so they differ by float32 rounding, which
# contacts multiply. Against the C engine, the difference was at most 6e-6 m in 100 steps.
DRIFT = 1e-5


def test_the_rollout_is_what_single_steps_make(run: Run, replay: Replay) -> None:
    trajectory, came = run.trajectory, replay.came
    for name in ("terminated", "truncated", "valid"):
        np.testing.assert_array_equal(getattr(trajectory, name)[:, 0], getattr(came, name), name)
    np.testing.assert_allclose(trajectory.reward[:, 0], came.reward, atol=DRIFT)
    # Parked robots stand on their targets, so the bearing of their target is arbitrary.
    present = replay.seen[..., DISTANCE] > 0.0
    np.testing.assert_allclose(
        trajectory.observation[:, 0][present], replay.seen[present], atol=20 * DRIFT
    )  # 20: at 0.05 m, a bearing turns by 1 / 0.05 rad for each metre that the robot moves
    assert came.terminated.any()
    assert came.truncated.any()
    np.testing.assert_allclose(run.after.sim.qpos, replay.last.sim.qpos, atol=DRIFT)
    np.testing.assert_array_equal(run.after.clock, replay.last.clock)
    np.testing.assert_array_equal(run.after.cohort, replay.last.cohort)


def test_some_episodes_end_and_others_go_on(run: Run, replay: Replay) -> None:
    over = replay.fresh
    assert over[:, BROKEN].tolist() == [True] + [False] * 7
    assert [int(over[:, a].argmax()) for a in (2, 3, 4, 5, 6)] == [6, 5, 4, 3, 2]
    assert over[:, ARRIVES].any(), "all arrive"
    assert not over[:, 0].any()
    expected = np.where(over.any(axis=0), NEXT, NOW)
    np.testing.assert_array_equal(run.after.cohort, expected)


def test_value_after_an_episode_is_of_what_it_came_to_not_of_the_next_start(
    program: Program, run: Run, replay: Replay
) -> None:
    found = run.trajectory
    value = _values(program, run.learners, replay.seen)
    next_value = _values(program, run.learners, replay.came.observation)
    start = _values(program, run.learners, np.asarray(run.starts.observation))
    present = replay.seen[..., DISTANCE] > 0.0  # as above
    # 1e-5: a bearing drifts by 2e-4, and an untrained network has a slope of about 0.01.
    np.testing.assert_allclose(found.value[:, 0][present], value[present], atol=1e-5)
    np.testing.assert_allclose(found.next_value[:, 0][present], next_value[present], atol=1e-5)
    for t, arena in zip(*np.nonzero(replay.fresh[:-1]), strict=True):
        there = present[t, arena]
        found_next = found.value[t + 1, 0, arena]
        np.testing.assert_allclose(found_next, start[arena], atol=1e-6)  # float32
        assert np.abs(found.next_value[t, 0, arena] - found_next)[there].max() > 1e-4
    # In the middle of an episode, the next value equals the value of the next step.
    going = ~replay.fresh[:-1]
    np.testing.assert_array_equal(found.next_value[:-1, 0][going], found.value[1:, 0][going])


def test_actions_are_drawn_from_the_policy(program: Program, run: Run) -> None:
    one = jax.tree.map(lambda leaf: leaf[0], run.learners)
    action, seen = run.trajectory.action[:, 0], jnp.asarray(run.trajectory.observation[:, 0])
    mode, _, _ = program.ppo.act(one, seen, jnp.zeros_like(action))
    noise = (action - mode) / 0.6  # the initial deviation
    # 384 standard normal numbers: mean within 5 / sqrt(384), variance within 5 sqrt(2 / 384).
    assert abs(noise.mean()) < 0.26
    assert abs(noise.var() - 1.0) < 0.36
    density = -0.5 * noise**2 - np.log(0.6 * np.sqrt(2 * np.pi))
    # 1e-4: float32 rounding of squares of up to 10.
    np.testing.assert_allclose(run.trajectory.log_prob[:, 0], density.sum(axis=-1), atol=1e-4)


def test_a_broken_arena_starts_afresh_and_nothing_of_it_is_learnt(run: Run) -> None:
    assert not run.trajectory.valid[0, 0, BROKEN].any()
    assert run.ended.broken[:, BROKEN].tolist() == [1] + [0] * 7
    assert run.ended.broken.sum() == 1
    for leaf in jax.tree.leaves((run.trajectory, run.after.sim, run.after.episode)):
        assert np.isfinite(leaf).all()
    assert run.after.clock[BROKEN] == 7


def test_a_level_counts_once_a_rollout(program: Program, run: Run) -> None:
    # Episodes end at 16 control steps: running episodes after one step, and waiting episodes after
    # three more.
    before = dataclasses.replace(run.before, clock=jnp.full(ARENAS, 15, jnp.int32))
    starts = dataclasses.replace(run.starts, clock=jnp.full(ARENAS, 13, jnp.int32))
    collect = jax.jit(functools.partial(rollout.collect, program))
    after, _, ended = collect(run.learners, before, starts, jax.random.key(2))
    uncounted = UNCOUNTED
    none = [-1, -1]
    expected = [NOW, *none, NEXT, *none, uncounted, -1]
    for arena in range(ARENAS):
        if arena not in (BROKEN, ARRIVES):
            assert ended.cohort[:, arena].tolist() == expected
            assert ended.episodes[:, arena].tolist() == [1, 0, 0, 1, 0, 0, 1, 0]  # still trained on
            assert after.cohort[arena] == uncounted


def test_a_long_rollout_draws_an_episode_for_every_32_control_steps(
    tiny_config: TrainConfig,
) -> None:
    def waiting(steps: int) -> int:
        algo = dataclasses.replace(tiny_config.algo, rollout_length=steps)
        return dataclasses.replace(tiny_config, algo=algo, budget=8 * steps).waiting

    assert [waiting(steps) for steps in (1, 32, 63, 64, 6000)] == [1, 1, 1, 2, 187]


def test_a_run_may_choose_how_many_episodes_are_drawn(tiny_config: TrainConfig) -> None:
    assert dataclasses.replace(tiny_config, levels_per_rollout=3).waiting == 3


@pytest.mark.slow
def test_episodes_that_wait_are_begun_in_turn_and_all_count(
    program: Program, run: Run, draw: Draw
) -> None:
    before = dataclasses.replace(run.before, clock=jnp.full(ARENAS, 15, jnp.int32))
    drawn = [draw(seed, NEXT) for seed in (11, 12, 13)]
    starts = jax.tree.map(lambda *x: jnp.concatenate(x), *drawn)
    starts = dataclasses.replace(starts, clock=jnp.full(3 * ARENAS, 13, jnp.int32))
    collect = jax.jit(functools.partial(rollout.collect, program))
    after, trajectory, ended = collect(run.learners, before, starts, jax.random.key(2))
    one = jax.tree.map(lambda x: x[0], run.learners)
    values, _ = program.ppo.value(one, starts.observation)
    for arena in range(ARENAS):
        if arena in (BROKEN, ARRIVES):
            continue
        assert ended.cohort[:, arena].tolist() == [NOW, -1, -1, NEXT, -1, -1, NEXT, -1]
        for turn, first in enumerate((1, 4, 7)):
            mine = turn * ARENAS + arena
            seen = trajectory.observation[first, 0, arena]
            np.testing.assert_array_equal(seen, starts.observation[mine])
            # float32: a matrix product of another width rounds differently.
            np.testing.assert_allclose(
                trajectory.value[first, 0, arena], values[mine], rtol=1e-4, atol=1e-5
            )
        assert after.level.seed[arena] == starts.level.seed[2 * ARENAS + arena]
        assert after.cohort[arena] == NEXT


def _recount(run: Run, replay: Replay, arena: int) -> dict[int, dict[str, object]]:
    """Returns the ended episodes of an arena by their last step, counted from the replay."""
    found, begin, clock, cohort, level = {}, 0, CLOCK[arena], NOW, _at(run.before.level, arena)
    for end in np.flatnonzero(replay.fresh[:, arena]):
        came = _at(replay.came, (slice(begin, end + 1), arena))
        sensed = came.valid & (came.observation[..., INFRARED].min(axis=-1) < RANGE)
        found[int(end)] = {
            "episodes": 1,
            "stage": arena % 2,
            "cohort": cohort,
            "targets": level.present.sum(),
            "reached": came.terminated.sum(),
            "all_reached": came.terminated.sum() == level.present.sum(),
            "steps": clock + len(came.done),
            "robot_steps": came.valid.sum(),
            "sensed": sensed.sum(),
            "contacts": _contacts(level, replay.pose[begin : end + 1, arena]),
            "reward": pytest.approx(came.reward.sum(), abs=DRIFT),
            "broken": 0,
        }
        begin, clock, cohort, level = end + 1, 0, NEXT, _at(run.starts.level, arena)
    return found


def _contacts(level: Level, poses: np.ndarray) -> list[int]:
    """Counts the contacts of each kind, of all robots of an arena, along their poses [T, R, 3]."""
    total, apart = np.zeros((ROBOTS, 3), int), np.full((ROBOTS, 3), gaps.CONTACT_PAUSE)
    for pose in poses:
        gap = gaps.gaps(pose, level.side, level.obstacle, HULL, np)
        begins, apart = gaps.count_contacts(gap, apart, 0.032, np)
        total += begins & level.present[:, None]
    return total.sum(axis=0).tolist()


def test_ended_episodes_add_up(run: Run, replay: Replay) -> None:
    contacts = np.zeros(3, int)
    for arena in set(range(ARENAS)) - {BROKEN}:  # its poses are not finite
        expected = _recount(run, replay, arena)
        for t in range(T):
            ended = _at(run.ended, (t, arena))
            if t not in expected:
                nothing = ended._replace(cohort=ended.cohort + 1)
                assert not any(np.any(leaf) for leaf in nothing)
                continue
            found = ended._replace(contacts=ended.contacts.tolist())._asdict()
            assert found.pop("robots") is None  # without run.episodes
            assert found.pop("measured") is None  # navigation has no measures of its own
            assert found == expected[t]
            contacts += found["contacts"]
    assert contacts.any()
