"""Compares the judge on the device with the judge in MuJoCo C, on the same levels and policies."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import policies
import pytest
import steering
from sentences import refusal

from swarmjax import policy_file
from swarmjax.evaluate import cells, engine_mjx
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import Evaluation, evaluate
from swarmjax.evaluate.measures import MEASURES
from swarmjax.sim.config import RobotConfig
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


def _judge(path: Path, stage: StageConfig, engine: Literal["c", "mjx"], **rest: Any) -> Evaluation:
    """Evaluates a policy as the command does, with one of its engines; by default planar."""
    given = {"robot": RobotConfig(), "seed": SEED, "episodes": EPISODES, "steps": STEPS} | rest
    settings = EvaluateConfig(policy=str(path), stage=stage, engine=engine, workers=1, **given)
    return evaluate(settings)


# --- the command with engine=mjx


@pytest.mark.parametrize(
    ("body", "learners", "deviation"),
    [
        ("planar", 3, 0.1),
        pytest.param("wheeled", 1, 0.02, marks=pytest.mark.slow),
    ],
)
def test_the_engines_of_the_command_agree(
    tmp_path: Path, body: Any, learners: int, deviation: float
) -> None:
    """The policy samples its actions; both engines have the same levels and physics steps."""
    kind = "shared" if learners == 1 else "independent"
    # Each learner and action has its own deviation, so a deviation of another learner or action
    # would give another path.
    drawn = np.log(deviation * np.linspace(0.5, 1.5, 2 * learners)).reshape(learners, 2)
    path = steering.write(tmp_path / "policy.npz", STEER, learners, drawn, policy=kind)
    count = 12
    common = {"robot": RobotConfig(body=body), "episodes": count}
    still = _judge(path, STAGES[1], "c", action="mean", **common)
    by_c, by_mjx = (_judge(path, STAGES[1], engine, **common) for engine in ("c", "mjx"))
    assert by_mjx.result["engine"] == "mjx"
    keys = ("cell", "digest", "unreachable", "episodes")
    for key in keys:
        assert by_mjx.result["cells"][0][key] == by_c.result["cells"][0][key]
    (c,), (mjx,) = by_c.trials, by_mjx.trials
    np.testing.assert_array_equal(c.shortest, mjx.shortest)
    assert set(c.measures) == set(mjx.measures)
    free = c.measures["contacts_per_robot"][0] == 0.0
    assert 2 < free.sum() < count
    # Sampling changes the path efficiency by more than twice the tolerance below.
    (mean,) = still.trials
    assert np.abs(mean.measures["spl"] - c.measures["spl"])[0, free].max() > 4e-3
    for name, found in mjx.measures.items():
        # Without contact, paths differ by rounding, which may shift a count by one step. Path
        # lengths are sums of 120 float32 strides.
        step = 1.01 / STEPS if name == "ir_steps_share" else 1.01 * CONTROL_STEP
        np.testing.assert_allclose(
            found[0, free], c.measures[name][0, free], atol=step, err_msg=name
        )
        # With contacts, at most one robot of one level ends differently, since the solvers stop at
        # different errors. If it meets another robot once more, each of the two counts a contact.
        twice = name in ("contacts_per_robot", "contacts_robot")
        ends = (2.01 if twice else 1.01) / (count * STAGES[1].robots)
        most = 3 * CONTROL_STEP if MEASURES[name].unit == "s" else ends
        np.testing.assert_allclose(found.mean(), c.measures[name].mean(), atol=most, err_msg=name)
    np.testing.assert_allclose(mjx.measures["spl"][0, free], c.measures["spl"][0, free], atol=2e-3)
    for name in ("targets_reached", "all_reached", "contacts_per_robot"):
        np.testing.assert_array_equal(mjx.measures[name][0, free], c.measures[name][0, free])


@pytest.mark.slow
def test_the_engines_agree_on_a_policy_that_remembers(tmp_path: Path) -> None:
    given, told = policies.recalling(steering.arrays((STEER,)), 6)
    given["actor/mean/kernel"][:, 2:] *= 0.3  # smaller, beside the steering
    none = {name: array * ("memory" not in name) for name, array in given.items()}
    path = tmp_path / "policy.npz"
    said = policies.meta(activation="relu", **told)
    policy_file.write(path, given | {"actor/log_std": np.full((1, 2), -3.0, np.float32)}, said)
    c, mjx = (_judge(path, STAGES[0], engine, episodes=8).trials[0] for engine in ("c", "mjx"))
    free = c.measures["contacts_per_robot"][0] == 0.0
    assert free.sum() > 2
    np.testing.assert_allclose(mjx.measures["spl"][0, free], c.measures["spl"][0, free], atol=2e-3)
    # Without its memory the policy drives another path: the difference is three times the
    # tolerance between the engines.
    other = tmp_path / "other.npz"
    policy_file.write(other, none | {"actor/log_std": np.full((1, 2), -3.0, np.float32)}, said)
    forgetful = _judge(other, STAGES[0], "c", episodes=8).trials[0]
    assert np.abs(forgetful.measures["spl"] - c.measures["spl"])[0, free].max() > 6e-3


def test_boxes_beyond_what_the_engine_is_compiled_for_are_refused() -> None:
    config = EvaluateConfig(policy="p", stage=STAGES[0], engine="mjx")
    sentence = refusal(engine_mjx.load, config, np.array([[0.2, 0.05]]), 2)
    assert sentence.startswith("obstacle_size is 0.4: give ")


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
