"""Checks what a run says at its end."""

from dataclasses import replace
from pathlib import Path

import pytest

from swarmjax import words
from swarmjax.run import sentences
from swarmjax.run.load_settings import load_train

SETTINGS = load_train(["stage=curriculum", "stage.sequence=[s1,s2]"])


@pytest.mark.parametrize(
    ("by_seed", "said"),
    [
        ([[0.9, 0.65]], "65.0 % within 500 control steps (16 s), over 40 episodes"),
        ([[None, 0.5], [None, 0.7]], "60.0 % (50 to 70) within 500 control steps (16 s)"),
        ([[0.9, None]], "not measured yet: the run was too short on this stage"),
    ],
)
def test_a_run_ends_with_its_last_stage(by_seed: list, said: str) -> None:
    newest = [{"success_by_stage": shares, "episodes_by_stage": [9, 40]} for shares in by_seed]
    assert sentences.success(SETTINGS, newest).startswith(f"targets reached on s2: {said}")


@pytest.mark.parametrize("seeds", [1, 16])
def test_the_first_line_names_stages_updates_and_folder(seeds: int) -> None:
    (said,) = sentences.first(replace(SETTINGS, seeds=seeds), Path("runs/a"), None, None)
    of = " of seeds 0 to 15" if seeds > 1 else ""
    assert said.startswith(f"curriculum s1 to s2, 732 updates{of} on ")
    assert said.endswith("into\0runs/a")


def test_the_first_line_of_the_default_run_fits_100_columns() -> None:
    run = Path("runs/20261128-215454-curriculum-seed0")
    (said,) = sentences.first(load_train([]), run, None, None)
    assert len(words.lines(said, 100).splitlines()[0]) <= 100
    assert str(run) in said


def test_a_next_command_is_not_broken() -> None:
    run = Path("runs") / ("long" * 12)
    said = words.lines(sentences.closing(SETTINGS, run, SETTINGS.updates, ended=True))
    assert said.splitlines()[-1].strip() == f"python -m swarmjax.evaluate policy={run}/policy.npz"
