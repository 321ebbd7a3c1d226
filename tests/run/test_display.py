"""Checks what a run shows while it trains."""

import io
import sys

import pytest
from rich.console import Console

from swarmjax.run.display import Display, StageState, summarize, working

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
    summary = summarize([ROW], NAMES)
    assert summary["cohort_targets"] == (0.25, 0.25, 0.25)
    assert summary["cohort_complete"] == (0.125, 0.125, 0.125)
    assert summary["ended_targets"] == (0.75, 0.75, 0.75)


def test_a_summary_is_over_the_newest_stage_only() -> None:
    older = ROW | {"stage": "s1", "reached": 0, "targets": 100}
    idle = ROW | {"episodes": 0, "targets": 0, "reached": 0, "reward": 0.0, "contacts": 0}
    summary = summarize([older, ROW, idle], NAMES)
    assert summary["stage"] == "s2"
    assert summary["ended_targets"] == (3 / 4, 3 / 4, 3 / 4)
    assert summary["contacts_per_robot"] == (6 / 4, 6 / 4, 6 / 4)
    assert summary["update"] == 10
    assert summarize([idle | {"complete": 0}], NAMES)["ended_targets"] is None


def test_seeds_are_summed_up_each_by_itself() -> None:
    again = ROW | {"targets": 16, "reached": 12}  # together with ROW: 15 of 20, which is 3 of 4
    summary = summarize([ROW, OTHER, again], NAMES)
    assert summary["stage"] == "s2 to s3"
    assert summary["ended_targets"] == ((3 / 4 + 1 / 4) / 2, 1 / 4, 3 / 4)
    assert summary["cohort_targets"] == (0.25, 0.25, 0.25)  # the other seed has none yet
    assert summary["episodes"] == 6


def test_stages_are_as_each_seed_saw_them_last() -> None:
    older = ROW | {"mix": [8, 0, 0], "success_by_stage": [0.1, None, None]}
    first, second, third = summarize([older, ROW, OTHER], NAMES)["stages"]
    assert first == StageState("s1", (2 / 8 + 0) / 2, ((0.95 + 0.85) / 2, 0.85, 0.95))
    assert second == StageState("s2", (6 / 8 + 4 / 8) / 2, ((0.25 + 0.75) / 2, 0.25, 0.75))
    assert third == StageState("s3", (0 + 4 / 8) / 2, None)


def _shown(terminal: bool, rows: list, names: list[str]) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100)
    with Display(100, console) as display:
        display.say("a sentence that stays, however long it may be, " * 4)
        display.show(summarize(rows, names), SPEEDS, 75.0)
    file = console.file
    assert isinstance(file, io.StringIO)
    return file.getvalue()


def _line_of(shown: str, name: str) -> str:
    """Returns the line that begins with a name.

    The line is there twice, since the table is shown once more when the display closes.
    """
    [line] = {line for line in shown.splitlines() if line.startswith(name)}
    return line


def test_plain_lines_where_there_is_no_terminal() -> None:
    sentence, line = _shown(False, [ROW], NAMES).splitlines()
    assert sentence.count("stays") == 4
    for part in ("update 10/100", "stage s2", "1,000", "4,321", "1 min 15 s"):
        assert part in line
    assert "targets reached 25.0 % (75.0 % in episodes just ended)" in line
    assert "1 of 3 stages above 90 %, worst s2 25.0 %" in line
    assert "\x1b" not in line


def test_a_table_on_a_terminal() -> None:
    shown = _shown(True, [ROW], NAMES)
    for part in ("transitions/s", "4,321", "12.5 s", "10 of 100"):
        assert part in shown
    assert "25.0 %" in _line_of(shown, "│ targets reached")
    assert "12.5 %" in _line_of(shown, "│ all robots reached")
    assert "75.0 %" in _line_of(shown, "│ - in episodes just ended")
    assert "95.0 %" in _line_of(shown, " s1 ")
    assert "75 %" in _line_of(shown, " s2 ")
    assert "-" in _line_of(shown, " s3 ")


def test_several_seeds_are_shown_with_their_range() -> None:
    shown = _shown(True, [ROW, OTHER], NAMES)
    assert "50.0 % (25 to 75)" in _line_of(shown, "│ - in episodes just ended")
    assert "90.0 % (85 to 95)" in _line_of(shown, " s1 ")
    assert "stage s2 to s3" in shown
    # The mean of 0.95 and 0.85 is 0.9, up to rounding, and 0.9 is not above 90 %.
    assert "0 of 3 stages above 90 %" in shown


def test_what_no_cohort_has_measured_is_said() -> None:
    assert "not measured yet" in _line_of(_shown(True, [OTHER], NAMES), "│ targets reached")
    assert "targets reached not measured yet (25.0 % in" in _shown(False, [OTHER], NAMES)


def test_of_many_stages_the_best_and_the_worst_are_shown() -> None:
    names = [f"n{i}" for i in range(9)]
    success = [None, 0.91, 0.92, 0.5, 0.99, 0.4, 0.93, 0.9, 0.6]
    row = ROW | {
        "stage": "n8",
        "mix": [1, 1, 1, 1, 1, 1, 1, 9, 0],
        "success_by_stage": success,
        "complete_by_stage": success,
    }
    shown = _shown(True, [row], names)
    assert "99.0 %" in _line_of(shown, " best: n4")
    assert "40.0 %" in _line_of(shown, " worst: n5")
    assert "56 %" in _line_of(shown, " most arenas: n7")  # 9 of 16
    assert "4 of 9 stages above 90 %" in shown
    assert "n3" not in shown


def _worked(terminal: bool) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100)
    with Display(100, console) as display, display.working("compiling"):
        pass
    file = console.file
    assert isinstance(file, io.StringIO)
    return file.getvalue()


def test_a_terminal_shows_for_how_long_something_is_under_way() -> None:
    assert "compiling" in _worked(True)
    assert "0:00:00" in _worked(True)


def test_a_plain_line_says_what_is_under_way() -> None:
    assert _worked(False) == "compiling ...\n"


def test_scripts_that_read_standard_error_see_no_sign_of_life(capsys) -> None:
    with working("starting"):
        pass
    assert capsys.readouterr() == ("", "")


def test_a_single_stage_has_no_table_of_stages() -> None:
    row = ROW | {"stage": "s1", "mix": [8], "success_by_stage": [0.25], "complete_by_stage": [0.25]}
    assert "stages above" not in _shown(True, [row], ["s1"])
    assert "stages above" not in _shown(False, [row], ["s1"])


class _Gone(io.StringIO):
    """An output that cannot be written, such as a closed terminal or a pipe without a reader."""

    def __init__(self, error: type[OSError]) -> None:
        """Sets the error that each write raises."""
        super().__init__()
        self._error = error

    def write(self, _: str) -> int:
        """Raises the error."""
        raise self._error


@pytest.mark.parametrize("error", [OSError, BrokenPipeError])
def test_a_reader_that_is_gone_does_not_stop_the_run(
    error: type[OSError], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdout", _Gone(error))
    with Display(10) as display:
        display.say("a sentence")
