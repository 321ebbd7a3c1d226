"""Checks what a run shows while it trains."""

import time

import pytest

from swarmjax import life
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
SPEEDS = {"arena_steps_per_s": 1000.0, "physics_steps_per_s": 1000.0}


def test_a_cohort_says_how_good_the_swarm_is() -> None:
    found = figures([ROW], NAMES)
    assert found == {"stage": "s2", "targets reached": "25.0 %", "all robots reached": "12.5 %"}


def test_several_seeds_are_shown_with_their_range() -> None:
    two = OTHER | {"stage": "s2"}
    assert figures([ROW, two], NAMES)["targets reached"] == "50.0 % (25 to 75)"
    assert figures([ROW, OTHER], NAMES)["stage"] == "s2 to s3"


def test_what_no_cohort_has_measured_is_said() -> None:
    assert figures([OTHER], NAMES)["targets reached"] == "not measured yet"
    assert spread([None, 0.25]) == "25.0 %"


def test_a_run_is_shown_in_lines(capsys: pytest.CaptureFixture[str]) -> None:
    display = Display()
    display.say("a sentence")
    for update in (10, 11, 100):
        display.show(figures([ROW], NAMES), update, 100, 75.0, SPEEDS)
    assert capsys.readouterr().out.splitlines() == [
        "a sentence",
        "update 10 of 100  stage s2  targets reached 25.0 %  all robots reached 12.5 %  "
        "1 min 15 s left  1,000 steps/s",
        "update 100 of 100  stage s2  targets reached 25.0 %  all robots reached 12.5 %  "
        "1 min 15 s left  1,000 steps/s",
    ]


def test_the_state_of_a_run_stays_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    long = "a_stage_with_a_long_name" * 3
    Display().show(figures([ROW | {"stage": long}], ["", long]), 10**6, 10**9, 1e8, SPEEDS)
    (line,) = capsys.readouterr().out.splitlines()
    assert len(line) <= 120
    assert "..." in line


def test_long_work_is_shown_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(life, "EVERY_S", 0.05)
    with Display().busy("compiling"):
        time.sleep(0.5)
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "compiling ..."
    assert second.startswith("still compiling after ")


def test_a_quiet_display_shows_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    display = Display(quiet=True)
    display.say("a sentence")
    with display.busy("compiling"):
        pass
    display.show(figures([ROW], NAMES), 100, 100, 75.0, SPEEDS)
    assert capsys.readouterr().out == ""
