"""Compares the judge on the device with the judge in MuJoCo C, on the same levels and policies."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import policies
import pytest
import steering
from policies import EMBODIMENT
from sentences import refusal

from swarmjax import policy_file
from swarmjax.evaluate import cells, engine_mjx
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.engine_mjx import Outcomes
from swarmjax.evaluate.evaluation import Evaluation, evaluate
from swarmjax.evaluate.measures import MEASURES
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.learner import LearnerState
from swarmjax.ppo.normalizer import Normalizer
from swarmjax.sim.config import RobotConfig, SimConfig
from swarmjax.task import env, level, observation
from swarmjax.task import stage as task_stage
from swarmjax.task.env import World
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig

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
    return env.load(STAGES, sim=SimConfig(impl="jax", max_robots=3, max_obstacles=2))


@pytest.fixture(scope="module")
def judge(world: World) -> Run:
    algo = AlgoConfig(hidden_sizes=(2,), activation="relu")
    return jax.jit(partial(engine_mjx.outcomes, world, algo, steps=STEPS))


@pytest.fixture(scope="module", params=STAGES, ids=lambda stage: stage.name)
def stage(request: pytest.FixtureRequest) -> StageConfig:
    return request.param


@pytest.fixture(scope="module")
def levels(world: World, stage: StageConfig) -> Level:
    return engine_mjx.draw_levels(world, stage, SEED, EPISODES)


def _arrays(drives: tuple) -> dict[str, np.ndarray]:
    """Returns policies with one hidden layer, relu(bearing) and relu(-bearing); one per robot."""
    count = len(drives)
    bearing = np.zeros((count, observation.SIZE, 2), np.float32)
    bearing[:, observation.NAMES.index("target_bearing")] = [1.0, -1.0]
    drive = np.array(drives, np.float32)
    return {
        "actor/hidden_0/kernel": bearing,
        "actor/hidden_0/bias": np.zeros((count, 2), np.float32),
        "actor/mean/kernel": drive[:, 1:],
        "actor/mean/bias": drive[:, 0],
        "actor/log_std": np.zeros((count, 2), np.float32),
        "normalizer/mean": np.zeros((count, observation.SIZE), np.float32),
        "normalizer/std": np.ones((count, observation.SIZE), np.float32),
    }


def _learners(*drives: tuple) -> LearnerState:
    """Returns the same policies as learners [L], with only the parts that acting needs."""
    arrays = _arrays(drives)

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
    policy_file.write(path, _arrays(drives), meta)
    (trial,) = _judge(path, stage, "c", action="mean").trials
    return {name: trial.found[name][0] for name in Outcomes._fields if name != "broken"}


def _judge(path: Path, stage: StageConfig, engine: Literal["c", "mjx"], **rest: Any) -> Evaluation:
    """Evaluates a policy as the command does, with one of its engines; by default planar."""
    given = {"robot": RobotConfig(), "seed": SEED, "episodes": EPISODES, "steps": STEPS} | rest
    settings = EvaluateConfig(policy=str(path), stage=stage, engine=engine, workers=1, **given)
    return evaluate(settings)


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
    # Absent things stand 5 m out and 0.5 m apart: robot i at (5 + i / 2, 5), and obstacle j at
    # (-5 - j / 2, -5).
    for i in range(stage.robots, 3):
        np.testing.assert_array_equal(levels.start[:, i], [[5 + 0.5 * i, 5, 0]] * EPISODES)
        np.testing.assert_array_equal(levels.target[:, i], [[5 + 0.5 * i, 5]] * EPISODES)
    for j in range(stage.obstacles, 2):
        place = [[-5 - 0.5 * j, -5, 0]] * EPISODES
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
    levels = engine_mjx.draw_levels(world, STAGES[1], SEED, EPISODES)
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
    levels = engine_mjx.draw_levels(world, STAGES[0], SEED, EPISODES)
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
    levels = engine_mjx.draw_levels(world, STAGES[0], SEED, EPISODES)
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
        sentence = refusal(engine_mjx.draw_levels, world, stage, 0, 1)
        assert f"{key} is {count}" in sentence
        assert f"sim.max_{key}={count}" in sentence


# --- the command with engine=mjx


@pytest.mark.parametrize(
    ("body", "shape", "learners", "deviation"),
    [
        ("planar", "ell", 3, 0.1),
        pytest.param("wheeled", "box", 1, 0.02, marks=pytest.mark.slow),
    ],
)
def test_the_engines_of_the_command_agree(
    tmp_path: Path, body: Any, shape: Any, learners: int, deviation: float
) -> None:
    """The policy samples its actions; both engines have the same levels and physics steps."""
    kind = "shared" if learners == 1 else "independent"
    # Each learner and action has its own deviation, so a deviation of another learner or action
    # would give another path.
    drawn = np.log(deviation * np.linspace(0.5, 1.5, 2 * learners)).reshape(learners, 2)
    path = steering.write(tmp_path / "policy.npz", STEER, learners, drawn, policy=kind)
    count = 12
    common = {"robot": RobotConfig(body=body), "shape": shape, "episodes": count}
    still = _judge(path, STAGES[1], "c", action="mean", **common)
    by_c, by_mjx = (_judge(path, STAGES[1], engine, **common) for engine in ("c", "mjx"))
    assert by_mjx.result["engine"] == "mjx"
    keys = ("cell", "digest", "unreachable", "shape", "episodes")
    for key in keys:
        assert by_mjx.result["cells"][0][key] == by_c.result["cells"][0][key]
    (c,), (mjx,) = by_c.trials, by_mjx.trials
    np.testing.assert_array_equal(c.shortest, mjx.shortest)
    missing = set(c.found) - set(mjx.found)
    assert missing == {name for name in c.found if name.startswith("impulse")}
    free = c.found["contacts_per_robot"][0] == 0.0
    assert 2 < free.sum() < count
    # Sampling changes the path efficiency by more than twice the tolerance below.
    (mean,) = still.trials
    assert np.abs(mean.found["spl"] - c.found["spl"])[0, free].max() > 4e-3
    for name, found in mjx.found.items():
        # Without contact, paths differ by rounding, which may shift a count by one step. Path
        # lengths are sums of 120 float32 strides.
        step = 1.01 / STEPS if name == "ir_steps_share" else 1.01 * CONTROL_STEP
        np.testing.assert_allclose(found[0, free], c.found[name][0, free], atol=step, err_msg=name)
        # With contacts, at most one robot of one level ends differently, since the solvers stop at
        # different errors. If it meets another robot once more, each of the two counts a contact.
        twice = name in ("contacts_per_robot", "contacts_robot")
        ends = (2.01 if twice else 1.01) / (count * STAGES[1].robots)
        most = 3 * CONTROL_STEP if MEASURES[name].unit == "s" else ends
        np.testing.assert_allclose(found.mean(), c.found[name].mean(), atol=most, err_msg=name)
    np.testing.assert_allclose(mjx.found["spl"][0, free], c.found["spl"][0, free], atol=2e-3)
    for name in ("targets_reached", "all_reached", "contacts_per_robot"):
        np.testing.assert_array_equal(mjx.found[name][0, free], c.found[name][0, free])


def test_the_engines_agree_on_a_policy_that_remembers(tmp_path: Path) -> None:
    given, told = policies.recalling(_arrays((STEER,)), 6)
    given["actor/mean/kernel"][:, 2:] *= 0.3  # smaller, beside the steering
    none = {name: array * ("memory" not in name) for name, array in given.items()}
    path = tmp_path / "policy.npz"
    said = policies.meta(activation="relu", **told)
    policy_file.write(path, given | {"actor/log_std": np.full((1, 2), -3.0, np.float32)}, said)
    c, mjx = (_judge(path, STAGES[0], engine, episodes=8).trials[0] for engine in ("c", "mjx"))
    free = c.found["contacts_per_robot"][0] == 0.0
    assert free.sum() > 2
    np.testing.assert_allclose(mjx.found["spl"][0, free], c.found["spl"][0, free], atol=2e-3)
    # Without its memory the policy drives another path: the difference is three times the
    # tolerance between the engines.
    other = tmp_path / "other.npz"
    policy_file.write(other, none | {"actor/log_std": np.full((1, 2), -3.0, np.float32)}, said)
    forgetful = _judge(other, STAGES[0], "c", episodes=8).trials[0]
    assert np.abs(forgetful.found["spl"] - c.found["spl"])[0, free].max() > 6e-3


def test_boxes_beyond_what_the_engine_is_compiled_for_are_refused() -> None:
    config = EvaluateConfig(policy="p", stage=STAGES[0], engine="mjx")
    sentence = refusal(engine_mjx.load, config, np.array([[0.2, 0.05]]), 2)
    assert sentence.startswith("stage s1: a box is 0.4 m long, but engine=mjx takes up to 0.3 m")


def test_an_engine_that_breaks_down_is_reported(tmp_path: Path) -> None:
    path = steering.write(tmp_path / "policy.npz")
    config = EvaluateConfig(policy=str(path), stage=STAGES[0], robot=RobotConfig(), episodes=3)
    (cell,) = cells.load(config).cells
    world = engine_mjx.load(config, cell.half, 3)
    start = cell.levels.start.copy()
    start[1, 0, 0] = np.nan
    levels = cell.levels._replace(start=start)
    sentence = refusal(engine_mjx.play, world, levels, policy_file.read(path), 3)
    assert sentence.startswith("the physics of 1 of 3 episodes broke down")
