"""Compares the judge of learners in training with MuJoCo C, on the same levels and policies."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest
import steering
from policies import EMBODIMENT
from sentences import refusal

from benchmarks import learners_judge
from benchmarks.learners_judge import Outcomes
from swarmjax import policy_file
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import evaluate
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Normalizer, Sizes
from swarmjax.ppo.ppo import LearnerState
from swarmjax.sim.config import RobotConfig, SimConfig
from swarmjax.task import level, observation
from swarmjax.task import stage as task_stage
from swarmjax.task import world as task_world
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.world import World

STAGES = (
    StageConfig(name="s1", robots=2, side=0.5),
    StageConfig(name="s3", robots=3, side=0.7, obstacles=1),
)
EPISODES, SEED = 40, 1
STEPS = 120  # Few enough that some robots are late.
CONTROL_STEP = 0.032  # Seconds.
# Hand-made policies: the action at bearing 0, and the changes per radian to the left and right.
STEER = ((1.0, 0.0), (-2.0, 2.0), (-2.0, -2.0))
STAY = ((-1.0, 0.0), (0.0, 0.0), (0.0, 0.0))

Run = Callable[[LearnerState, Level], Outcomes]


@pytest.fixture(scope="module")
def world() -> World:
    return task_world.load(STAGES, sim=SimConfig(impl="jax", max_robots=3, max_obstacles=2))


@pytest.fixture(scope="module")
def judge(world: World) -> Run:
    algo = AlgoConfig(hidden_sizes=(2,), activation="relu")
    ppo = learners.ppo(algo, Sizes(observation.SIZE, 2))
    return jax.jit(partial(learners_judge.outcomes, world, ppo, steps=STEPS))


@pytest.fixture(scope="module", params=STAGES, ids=lambda stage: stage.name)
def stage(request: pytest.FixtureRequest) -> StageConfig:
    return request.param


@pytest.fixture(scope="module")
def levels(world: World, stage: StageConfig) -> Level:
    return learners_judge.draw_levels(world, stage, SEED, EPISODES)


def _learners(*drives: tuple) -> LearnerState:
    """Returns the same policies as learners [L], with only the parts that acting needs."""
    arrays = steering.arrays(drives)

    def layer(name: str) -> dict[str, np.ndarray]:
        return {part: arrays[f"actor/{name}/{part}"] for part in ("kernel", "bias")}

    actor = {
        "torso": {"hidden_0": layer("hidden_0")},
        "mean": layer("mean"),
        "log_std": arrays["actor/log_std"],
    }
    mean, std = arrays["normalizer/mean"], arrays["normalizer/std"]
    seen = Normalizer(
        count=jnp.ones(len(drives)), mean=mean, variance=std**2, rest=jnp.zeros((len(drives), 2, 1))
    )
    return LearnerState(params={"actor": actor}, optimizer_state=(), normalizer=seen)


def _by_c(folder: Path, stage: StageConfig, drives: tuple) -> dict[str, np.ndarray]:
    """Evaluates the policies in MuJoCo C; returns their measures level by level."""
    meta = {
        "policy": "shared" if len(drives) == 1 else "independent",
        "learners": len(drives),
        "activation": "relu",
        "observation": observation.describe("metric") | {"limit": 10.0},
        "action": {
            "names": policy_file.ACTION_NAMES,
            "units": policy_file.ACTION_UNITS,
            "low": [0.0, -3.14],
            "high": [0.1256, 3.14],
        },
        "config": {},
        **EMBODIMENT,
        "versions": {},
        "update": 0,
    }
    path = folder / "policy.npz"
    policy_file.write(path, steering.arrays(drives), meta)
    settings = EvaluateConfig(
        policy=str(path),
        stage=stage,
        robot=RobotConfig(),
        action="mean",
        seed=SEED,
        episodes=EPISODES,
        steps=STEPS,
        workers=1,
    )
    (trial,) = evaluate(settings).trials
    return {name: trial.measures[name][0] for name in Outcomes._fields if name != "broken"}


def test_levels_are_those_of_the_other_judge(
    world: World, stage: StageConfig, levels: Level
) -> None:
    one = task_stage.select(task_stage.stack([stage]), np.intp(0))
    spacing = level.Spacing(stage.robots, stage.obstacles, 0.037, 0.05)
    for episode in (0, 7, EPISODES - 1):
        drawn = evaluate_judge.draw_level(one, spacing, SEED, episode)
        for name in ("present", "start", "target"):
            found = getattr(levels, name)[episode, : stage.robots]
            np.testing.assert_array_equal(found, getattr(drawn, name), err_msg=name)
        for name in ("obstacle_present", "obstacle"):
            found = getattr(levels, name)[episode, : stage.obstacles]
            np.testing.assert_array_equal(found, getattr(drawn, name), err_msg=name)
        assert levels.seed[episode] == drawn.seed
        assert levels.side[episode] == drawn.side


def test_what_a_level_lacks_is_parked_as_in_training(stage: StageConfig, levels: Level) -> None:
    # Absent things stand 30 m out and 0.5 m apart: robot i at (30 + i / 2, 30), and obstacle j at
    # (-30 - j / 2, -30).
    for i in range(stage.robots, 3):
        np.testing.assert_array_equal(levels.start[:, i], [[30 + 0.5 * i, 30, 0]] * EPISODES)
        np.testing.assert_array_equal(levels.target[:, i], [[30 + 0.5 * i, 30]] * EPISODES)
    for j in range(stage.obstacles, 2):
        place = [[-30 - 0.5 * j, -30, 0]] * EPISODES
        np.testing.assert_array_equal(levels.obstacle[:, j, :3], place)
        assert (levels.obstacle[:, j, 3:] > 0.0).all()
    assert levels.present.sum() == EPISODES * stage.robots
    assert levels.obstacle_present.sum() == EPISODES * stage.obstacles
    for field in levels:
        assert field.dtype in (np.float32, bool, np.uint32)


def test_agrees_with_mujoco_c(
    tmp_path: Path, judge: Run, stage: StageConfig, levels: Level
) -> None:
    expected = _by_c(tmp_path, stage, (STEER,))
    found = jax.tree.map(np.asarray, judge(_learners(STEER), levels))
    assert 0.0 < expected["all_reached"].mean() < 1.0
    free = expected["contacts_per_robot"] == 0.0
    assert 5 < free.sum() < EPISODES
    for name, values in expected.items():
        mine = getattr(found, name)
        # Paths without contact differ by rounding, by 1e-6 m, which shifts no arrival by a step.
        np.testing.assert_allclose(mine[free], values[free], atol=1e-6, err_msg=name)
        # Contacts magnify the difference, and the solvers stop at different errors. Here this
        # shifts times by single control steps. If rounding differs elsewhere, at most one robot of
        # one level may end differently.
        np.testing.assert_allclose(mine.mean(), values.mean(), atol=0.03, err_msg=name)
    assert not found.broken.any()


def test_each_learner_drives_its_own_robot(tmp_path: Path, judge: Run, world: World) -> None:
    drives = (STEER, STAY, STEER)
    levels = learners_judge.draw_levels(world, STAGES[1], SEED, EPISODES)
    found = judge(_learners(*drives), levels)
    expected = _by_c(tmp_path, STAGES[1], drives)
    # The second robot stays.
    assert np.asarray(found.targets_reached).max() == pytest.approx(2 / 3)
    # One robot of one level in 40 may end differently, since contacts magnify rounding.
    for name in ("targets_reached", "all_reached"):
        assert np.asarray(getattr(found, name)).mean() == pytest.approx(
            expected[name].mean(), abs=0.01
        )


@pytest.mark.slow
def test_seeds_side_by_side_are_judged_as_each_alone(judge: Run, world: World) -> None:
    levels = learners_judge.draw_levels(world, STAGES[0], SEED, EPISODES)
    one, two = _learners(STEER), _learners(STAY)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), one, two)
    found = jax.vmap(judge, in_axes=(0, None))(both, levels)
    for i, alone in enumerate((judge(one, levels), judge(two, levels))):
        for name, value in alone._asdict().items():
            # Batched matrix products round differently.
            np.testing.assert_allclose(getattr(found, name)[i], value, atol=1e-6, err_msg=name)
    assert found.targets_reached[0].mean() > 0.5
    np.testing.assert_array_equal(found.targets_reached[1], 0.0)
    np.testing.assert_allclose(found.episode_time_s[1], STEPS * CONTROL_STEP, rtol=1e-6)


def test_an_episode_whose_physics_breaks_ends_alone(judge: Run, world: World) -> None:
    levels = learners_judge.draw_levels(world, STAGES[0], SEED, EPISODES)
    expected = judge(_learners(STEER), levels)
    start = levels.start.copy()
    start[3, 0, 0] = np.nan
    found = judge(_learners(STEER), levels._replace(start=start))
    np.testing.assert_array_equal(found.broken, np.arange(EPISODES) == 3)
    others = np.arange(EPISODES) != 3
    for name in found._fields:
        mine, theirs = getattr(found, name), getattr(expected, name)
        np.testing.assert_array_equal(mine[others], theirs[others], err_msg=name)
    for name in ("targets_reached", "all_reached", "contacts_per_robot", "episode_time_s"):
        assert getattr(found, name)[3] == 0.0


def test_a_stage_that_does_not_fit_is_refused(world: World) -> None:
    many = StageConfig(name="many", robots=4, side=1.0)
    boxes = StageConfig(name="boxes", robots=1, side=1.0, obstacles=3)
    for stage, key, count in ((many, "robots", 4), (boxes, "obstacles", 3)):
        sentence = refusal(learners_judge.draw_levels, world, stage, 0, 1)
        assert f"{key} is {count}" in sentence
        assert f"sim.max_{key}={count}" in sentence
