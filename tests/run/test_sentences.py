"""Checks what a run says at its end."""

import pytest

from swarmjax.run import sentences
from swarmjax.run.load_settings import load_train

SETTINGS = load_train(["stage=curriculum", "stage.sequence=[s1,s2]"])


@pytest.mark.parametrize(
    ("by_seed", "said"),
    [
        ([[0.9, 0.65]], "on s2: 65.0 % within 500 control steps (16 s), in a whole cohort"),
        ([[None, 0.5], [None, 0.7]], "on s2: 60.0 % (50 to 70) within 500 control steps (16 s)"),
        ([[0.9, None]], "on s1: 90.0 % within 500 control steps (16 s), in a whole cohort"),
        ([[None, None]], ": not measured yet, since no whole cohort ended"),
    ],
)
def test_a_run_ends_with_the_furthest_stage_that_was_measured(by_seed: list, said: str) -> None:
    newest = [{"success_by_stage": shares} for shares in by_seed]
    sentence = sentences.success(SETTINGS, newest)
    assert sentence.startswith(f"targets reached{' ' if said[0] == 'o' else ''}{said}")


def test_a_run_that_measured_nothing_says_what_is_missing() -> None:
    assert "(16 updates)" in sentences.success(SETTINGS, [])  # 500 steps fill 16 rollouts of 32
