"""Checks what a run says at its end."""

import pytest

from swarmjax.run import sentences
from swarmjax.run.load_settings import load_train

SETTINGS = load_train(["stage=curriculum", "stage.sequence=[s1,s2]"])


@pytest.mark.parametrize(
    ("by_seed", "said"),
    [
        ([[0.9, 0.65]], "65.0 % within 500 control steps (16 s), in a whole cohort of 40 episodes"),
        ([[None, 0.5], [None, 0.7]], "60.0 % (50 to 70) within 500 control steps (16 s)"),
        ([[0.9, None]], "not measured yet: no whole cohort of episodes has ended"),
    ],
)
def test_a_run_ends_with_its_last_stage(by_seed: list, said: str) -> None:
    newest = [{"success_by_stage": shares, "episodes_by_stage": [9, 40]} for shares in by_seed]
    assert sentences.success(SETTINGS, newest).startswith(f"targets reached on s2: {said}")
