"""Checks the grids of stages that `curriculum.axes` makes."""

import numpy as np
import pytest

from swarmjax.config import ConfigError, to_dict
from swarmjax.curriculum import axes
from swarmjax.run.load_settings import from_stored, load_train
from swarmjax.run.settings import TrainConfig

WORDS = ("stage=s6", "curriculum.axes.robots=[2]", "curriculum.axes.distance=[0.1,[0.15,0.3]]")


@pytest.fixture(scope="module")
def config() -> TrainConfig:
    return load_train(WORDS)


def test_each_combination_is_a_stage_and_the_last_is_the_goal(config: TrainConfig) -> None:
    assert [(stage.robots, stage.distance) for stage in config.stage] == [
        *((2, 0.1), (2, (0.15, 0.3)), (2, None)),
        *((5, 0.1), (5, (0.15, 0.3)), (5, None)),
    ]
    assert config.stage_names == [
        *("s6-robots2-distance0p1", "s6-robots2-distance0p15to0p3", "s6-robots2-distanceany"),
        *("s6-robots5-distance0p1", "s6-robots5-distance0p15to0p3", "s6"),
    ]
    assert config.stage[-1] == load_train(["stage=s6"]).stage[0]


def test_the_mode_is_frontier_unless_given(config: TrainConfig) -> None:
    assert config.curriculum.mode == "frontier"
    given = load_train([*WORDS, "curriculum.mode=adaptive", "curriculum.floor=1"])
    assert given.curriculum.mode == "adaptive"
    assert len(given.stage) == 6


def test_a_stored_run_keeps_its_grid(config: TrainConfig) -> None:
    assert from_stored(to_dict(config)) == config


def test_a_stage_waits_for_those_one_step_easier() -> None:
    ahead = axes.easier({"robots": (2.0,), "distance": (0.1, 0.2)}, 6)
    waits = {i: np.flatnonzero(row).tolist() for i, row in enumerate(ahead)}
    assert waits == {0: [], 1: [0], 2: [1], 3: [0], 4: [1, 3], 5: [2, 4]}
    assert np.array_equal(axes.easier({}, 4), np.eye(4, k=-1, dtype=bool))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["curriculum.axes.speed=[1]"],
            "curriculum.axes.speed is not an axis: give one of robots, ",
        ),
        (["curriculum.axes.robots=[]"], "curriculum.axes.robots is []: give a list of values"),
        (["curriculum.axes.robots=2"], "curriculum.axes.robots is 2: give a list of values"),
        (["curriculum.axes=2"], "curriculum.axes is 2: give the values of each axis"),
        (["curriculum.axes.distance=[0.1,any]"], "curriculum.axes.distance holds 'any': give num"),
        (["curriculum.axes.robots=[true]"], "curriculum.axes.robots holds true: give numbers"),
        (["curriculum.axes.robots=[2,2]"], "curriculum.axes.robots holds 2 more than once"),
        (["curriculum.axes.robots=[2,5]"], "but stage.robots is 5: leave out this value"),
        (["curriculum.axes.robots=[2.5]"], "robots is 2.5: give a whole number"),
        (["curriculum.axes.robots=[9]", "sim.max_robots=5"], "but sim.max_robots is 5"),
        (["curriculum.axes.gap=[0.1]"], "gap is 0.1, but level is random, which has no gap"),
        (["curriculum.axes.distance=[0.3,[0.5,0.4]]"], "give the lower number first"),
        (["curriculum.axes.distance=[100]"], "distance is 100: give 0.05 to 50"),
        (
            ["stage=curriculum", "curriculum.axes.robots=[2]"],
            "stage lists 6: give a single stage, as in ",
        ),
        (
            [f"curriculum.axes.{key}={[0.5 + i / 100 for i in range(8)]}" for key in ("side",)]
            + [f"curriculum.axes.distance={[0.1 + i / 100 for i in range(8)]}"],
            "curriculum.axes makes 81 stages",
        ),
    ],
)
def test_an_impossible_grid_is_one_sentence(words: list[str], message: str) -> None:
    given = [*([] if words[0].startswith("stage") else ["stage=s6"]), *words]
    with pytest.raises(ConfigError) as raised:
        load_train(given)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_stored_grid_that_lacks_a_stage_is_refused(config: TrainConfig) -> None:
    stored = to_dict(config)
    stored["stage"] = stored["stage"][1:]
    with pytest.raises(ConfigError, match=r"curriculum.axes makes 6 stages, but stage lists 5"):
        from_stored(stored)
