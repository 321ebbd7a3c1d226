"""Checks what a run shows while it trains."""

import pytest

from swarmjax.run.display import Display, figures, spread

NAMES = ["s1", "s2", "s3"]
ROW = {
    "seed": 0,
    "stage": "s2",
    "update": 9,
    "episodes": 2,
    "targets": 4,
    "reached": 3,
    "complete": 1,
    "reward": 2.0,
    "contacts": 6,
    "value_loss": 0.5,
    "policy_loss": -0.01,
    "std": 0.6,
    "mix": [2, 6, 0],
    "success_by_stage": [0.95, 0.25, None],
    "complete_by_stage": [0.9, 0.125, None],
}
OTHER = ROW | {
    "seed": 1,
    "stage": "s3",
    "reached": 1,
    "mix": [0, 4, 4],
    "success_by_stage": [0.85, 0.75, None],
    "complete_by_stage": [0.8, 0.5, None],
}
SPEEDS = {
    "arena_steps_per_s": 1000.0,
    "robot_steps_per_s": 5000.0,
    "physics_steps_per_s": 2000.0,
    "transitions_per_s": 4321.0,
    "compile_s": 12.5,
}


def test_a_cohort_says_how_good_the_swarm_is() -> None:
    found = figures([ROW], NAMES, SPEEDS)
    assert found["stage"] == "s2"
    assert found["targets reached"] == "25.0 %"
    assert found["all robots reached"] == "12.5 %"
    assert found["targets in episodes just ended"] == "75 %"
    assert found["arena steps/s"] == "1,000"


def test_figures_are_over_the_newest_stage_of_each_seed() -> None:
    older = ROW | {"update": 8, "stage": "s1", "reached": 0, "targets": 100}
    found = figures([older, ROW], NAMES, SPEEDS)
    assert found["targets in episodes just ended"] == "75 %"
    assert found["contacts per robot"] == "1.5"
    idle = ROW | {"targets": 0, "reached": 0, "contacts": 0}
    assert figures([idle], NAMES, SPEEDS)["contacts per robot"] == "-"


def test_several_seeds_are_shown_with_their_range() -> None:
    two = OTHER | {"stage": "s2"}
    found = figures([ROW, two], NAMES, SPEEDS)
    assert found["targets reached"] == "50.0 % (25 to 75)"
    assert found["targets in episodes just ended"] == "50 %"
    assert figures([ROW, OTHER], NAMES, SPEEDS)["stage"] == "s2 to s3"


def test_what_no_cohort_has_measured_is_said() -> None:
    assert figures([OTHER], NAMES, SPEEDS)["targets reached"] == "not measured yet"
    assert spread([None, 0.25]) == "25.0 %"


def test_a_run_is_shown_in_lines(capsys: pytest.CaptureFixture[str]) -> None:
    display = Display()
    display.say("a sentence")
    for update in (10, 11, 100):
        display.show(figures([ROW], NAMES, SPEEDS), update, 100, 75.0)
    sentence, first, last = capsys.readouterr().out.splitlines()
    assert sentence == "a sentence"
    assert first.startswith("update 10 of 100  stage s2  targets reached 25.0 %  ")
    assert first.endswith("transitions/s 4,321  time left 1 min 15 s")
    assert last.startswith("update 100 of 100  ")


def test_a_quiet_display_shows_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    display = Display(quiet=True)
    display.say("a sentence")
    display.show(figures([ROW], NAMES, SPEEDS), 100, 100, 75.0)
    assert capsys.readouterr().out == ""
