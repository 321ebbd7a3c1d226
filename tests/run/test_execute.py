"""Checks the sentence that a run prints at its end."""

import pytest

from swarmjax.run import execute
from swarmjax.run.load_settings import load_train
from swarmjax.run.trainer import Tally

SETTINGS = load_train(["stage=curriculum", "stage.sequence=[s1,s2]"])


def _tally(*by_seed: dict[str, float]) -> Tally:
    reached = dict(enumerate(by_seed))
    return Tally(update=9, first=0, compile_s=1.0, transitions={}, targets_reached=reached)


@pytest.mark.parametrize(
    ("by_seed", "said"),
    [
        (
            [{"s1": 0.9, "s2": 0.65}],
            "targets reached on s2: 65.0 % within 500 control steps (16 s), in a whole cohort",
        ),
        (
            [{"s2": 0.5}, {"s2": 0.7}],
            "targets reached on s2: 60.0 % (50 to 70) within 500 control steps (16 s), in a whole",
        ),
        (
            [{"s1": 0.9}],
            "targets reached on s1: 90.0 % within 500 control steps (16 s), in a whole cohort",
        ),
    ],
)
def test_a_run_ends_with_the_furthest_stage_that_was_measured(by_seed, said) -> None:
    assert execute._success(SETTINGS, _tally(*by_seed)).startswith(said)


def test_a_last_stage_that_was_not_measured_is_named() -> None:
    assert execute._success(SETTINGS, _tally({"s1": 0.9})).endswith("; s2 was not measured yet")


def test_a_run_that_measured_nothing_says_what_is_missing() -> None:
    said = execute._success(SETTINGS, _tally({}))
    assert said.startswith("targets reached: not measured yet, since no whole cohort ended")
    assert "(16 updates)" in said  # 500 control steps fill 16 rollouts of 32
