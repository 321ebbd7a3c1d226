"""What a run shows."""

import io

from rich.console import Console

from swarmjax.display import Display, summarize

ROW = {
    "stage": "s2",
    "update": 9,
    "episodes": 2,
    "targets": 4,
    "reached": 3,
    "complete": 1,
    "reward": 2.0,
    "contacts": 6,
    "stage_success": 0.25,
    "value_loss": 0.5,
    "policy_loss": -0.01,
    "std": 0.6,
}
SPEEDS = {
    "arena_steps_per_s": 1000.0,
    "robot_steps_per_s": 5000.0,
    "physics_steps_per_s": 2000.0,
    "transitions_per_s": 4321.0,
    "compile_s": 12.5,
}


def test_a_summary_is_over_the_newest_stage_only() -> None:
    older = ROW | {"stage": "s1", "reached": 0, "targets": 100}
    idle = ROW | {"episodes": 0, "targets": 0, "reached": 0, "reward": 0.0, "contacts": 0}
    summary = summarize([older, ROW, idle])
    assert summary["targets_reached"] == 3 / 4
    assert summary["contacts_per_robot"] == 6 / 4
    assert summary["update"] == 10
    assert summarize([idle | {"complete": 0}])["targets_reached"] is None


def _shown(terminal: bool) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100)
    with Display(100, console) as display:
        display.say("a sentence that stays, however long it may be, " * 4)
        display.show(summarize([ROW]), SPEEDS, 75.0)
    file = console.file
    assert isinstance(file, io.StringIO)
    return file.getvalue()


def test_plain_lines_where_there_is_no_terminal() -> None:
    sentence, line = _shown(terminal=False).splitlines()
    assert sentence.count("stays") == 4
    for part in ("update 10/100", "stage s2", "75.0 %", "25.0 %", "1,000", "4,321", "1 min 15 s"):
        assert part in line
    assert "\x1b" not in line


def test_a_table_on_a_terminal() -> None:
    shown = _shown(terminal=True)
    for part in ("targets reached", "75.0 %", "transitions/s", "4,321", "12.5 s", "10 of 100"):
        assert part in shown
