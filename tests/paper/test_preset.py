"""Checks `algo=paper` against Table 1 of the paper row by row, independently of the defaults."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from sentences import refusal

from swarmjax import epuck
from swarmjax.command import help_text
from swarmjax.config import files
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import drive
from swarmjax.task import observation
from swarmjax.task import stage as task_stage
from swarmjax.task.config import RewardConfig

FILES = Path(files.__file__).resolve().parents[2] / "configs"
PAPER = load_train(["algo=paper"])
# Each row of Table 1, under its published name, with our setting and the published value.
TABLE_1 = {
    "max training timesteps": (PAPER.budget, 1_000_000),
    "Max timesteps per episode": (PAPER.task.step_limit, 1500),
    "state space dimension": (observation.SIZE, 10),
    "action space dimension": (drive.ACTION_SIZE, 2),
    "discount factor (gamma)": (PAPER.algo.discount, 0.99),
    "PPO epsilon clip": (PAPER.algo.clip_epsilon, 0.2),
    "PPO K epochs": (PAPER.algo.epochs, 80),
    "optimizer learning rate actor": (PAPER.algo.actor_learning_rate, 0.0003),
    "optimizer learning rate critic": (PAPER.algo.critic_learning_rate, 0.001),
    "starting std of action distribution": (PAPER.algo.initial_std, 0.6),
    "the decay rate of std of action distribution": (PAPER.algo.std_decrement, 0.05),
    "minimum std of action distribution": (PAPER.algo.std_floor, 0.1),
    "decay frequency of std of action distribution": (PAPER.algo.std_interval, 250_000),
}


@pytest.mark.parametrize("row", TABLE_1)
def test_every_row_of_table_1_is_in_the_preset_by_its_name(row: str) -> None:
    value, published = TABLE_1[row]
    assert value == published
    assert f'"{row}"' in (FILES / "algo" / "paper.yaml").read_text()


def test_the_help_names_the_rows_of_the_algorithm() -> None:
    text = help_text(TrainConfig, "swarmjax.train", ["algo"])
    algorithm = list(TABLE_1)[4:]
    assert [row for row in algorithm if f"'{row}'" not in text] == []


def test_the_preset_leaves_no_number_of_the_learner_to_a_default() -> None:
    given = files.read_choice("algo", "paper")
    of_others = {"gae_lambda", "memory_size"}  # of GAE, and of a memory
    others = of_others | {"update_backend", "network"}  # for speed or extensions
    keys = {f.name for f in dataclasses.fields(AlgoConfig) if not f.metadata["derived"]}
    assert set(given["algo"]) - {"name"} | others == keys
    rewards = {f.name for f in dataclasses.fields(RewardConfig)} - {"extra"}
    assert set(given["task"]["reward"]) == rewards
    # The weights of the paper's equation 3.
    weights = {name: weight for name, weight in vars(PAPER.task.reward).items() if weight}
    assert weights == {"progress": 1.0, "proximity": -0.001}


def test_the_preset_chooses_the_files_that_are_not_given() -> None:
    assert (PAPER.stage_name, PAPER.robot.max_speed) == ("paper_curriculum", 0.25)
    assert (PAPER.realism.name, PAPER.arenas, PAPER.updates) == ("webots", 1, 166)
    other = load_train(["algo=paper", "stage=paper6", "robot=planar", "realism=ideal", "seeds=10"])
    assert (other.stage_name, other.robot.max_speed) == ("paper6", epuck.MAX_SPEED)
    assert (other.realism.name, other.seeds) == ("ideal", 10)
    changed = load_train(["arenas=2", "algo.epochs=3", "algo=paper", "task.step_limit=100"])
    assert (changed.arenas, changed.algo.epochs, changed.task.step_limit) == (2, 3, 100)
    assert load_train([]).realism.name == "ideal"  # `algo=ppo`, the default, chooses no other file


def test_the_stages_are_fixed_levels_that_hold_their_robots() -> None:
    sizes = [(2, 0.5, 0), (2, 0.7, 0), (3, 0.7, 1), (3, 1.0, 2), (5, 1.0, 2), (5, 1.2, 3)]
    fence, boxes = PAPER.stage, load_train(["algo=paper", "stage=paper_boxes_curriculum"]).stage
    assert [(each.robots, each.side, each.obstacles) for each in boxes] == sizes
    for one, other in zip(fence, boxes, strict=True):
        assert (one.robots, one.side) == (other.robots, other.side)
        assert one.level == other.level == "fixed"
        assert other.layout == "boxes"
        assert (one.obstacles, one.layout) == ((1, "fence") if other.obstacles else (0, "boxes"))
    for name in ("paper_expanded", "paper_expanded_boxes"):
        (stage,) = load_train(["algo=paper", f"stage={name}"]).stage
        assert (stage.robots, stage.side, stage.level) == (5, 1.5, "fixed")
        task_stage.stack([stage])  # refuses a stage without enough room
    task_stage.stack([*fence, *boxes])


def test_the_clamp_of_each_wheel_takes_the_turn_of_a_fast_command() -> None:
    mine = drive.from_config(PAPER.robot)
    # The realised (v, w), in m/s and rad/s, were worked out by hand for wheels of 0.02 m on a track
    # of 0.052 m: a wheel turns at (v -/+ 0.026 w) / 0.02, at most 6.28 rad/s. The actions command
    # (0.25, 3.14), (0.0625, 3.14), (0, 3.14) and (0.25, 1.57). In the second, the wheels would
    # turn at -0.957 and 7.207 rad/s. So v = 0.01 (6.28 - 0.957) and w = (6.28 + 0.957) / 2.6.
    action = np.array([[1.0, 1.0], [-0.5, 1.0], [-1.0, 1.0], [1.0, 0.5]])
    wheels = drive.wheel_speeds(drive.command(action, mine, np), mine, np)
    found = drive.body_velocity(wheels, mine.wheel_radius, mine.track, np)
    # The tolerance covers the digits that are rounded off here.
    np.testing.assert_allclose(
        found, [[0.1256, 0.0], [0.053, 2.78], [0.0, 3.14], [0.1256, 0.0]], atol=6e-3
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["algo.advantage=monte_carlo", "algo.gae_lambda=0.9"],
         "algo.gae_lambda is 0.9, but advantage is monte_carlo and does not use gae_lambda: "
         "leave gae_lambda at 0.95, or give advantage=gae."),
        (["algo.std_floor=0.2"],
         "algo.std_floor is 0.2, but exploration is learned and does not use std_floor: leave "
         "std_floor at 0.1, or give exploration=scheduled."),
        (["algo=paper", "algo.std_floor=0.7"],
         "algo.std_floor is 0.7, but initial_std is 0.6: give at most 0.6."),
        (["algo.mean_activation=tanh", "algo.activation=relu"],
         "algo.mean_activation is tanh, but activation is relu and memory is none: give "
         "activation=tanh and memory=none, or mean_activation=linear."),
        (["algo=paper", "budget=5999"],
         "budget is 5999, but one update takes arenas x algo.rollout_length = 6000 control steps: "
         "give at least 6000."),
        (["algo.name=paper"], "algo.name cannot be set by itself: choose a file, as in algo=ppo."),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(words: list[str], sentence: str) -> None:
    assert refusal(load_train, words) == sentence
