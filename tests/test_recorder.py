"""What a run writes down."""

import json
from pathlib import Path

import numpy as np
import pytest

from swarmjax import recorder
from swarmjax.recorder import Recorder

METRICS = {
    "update": np.array([4, 5, 0]),
    "stage": np.array([0, 1, 0]),
    "episodes": np.array([2, 0, 0]),
    "targets": np.array([4, 0, 0]),
    "reached": np.array([3, 0, 0]),
    "complete": np.array([1, 0, 0]),
    "steps": np.array([30, 0, 0]),
    "robot_steps": np.array([50, 0, 0]),
    "sensed": np.array([5, 0, 0]),
    "reward": np.array([2.0, 0.0, 0.0]),
    "contacts_robot": np.array([2, 0, 0]),
    "contacts_obstacle": np.array([3, 0, 0]),
    "contacts_wall": np.array([1, 0, 0]),
    "stage_success": np.array([np.nan, 0.5, 0.0]),
}


def test_rows_are_counts_with_their_shares() -> None:
    first, second = recorder.rows(METRICS, 2, ["s1", "s2"], control_steps=100)
    assert first["stage"] == "s1"
    assert first["arena_steps"] == 500  # updates 0..4 of 100
    assert first["targets_reached"] == 3 / 4
    assert first["all_reached"] == 1 / 2
    assert first["return"] == 2.0 / 4
    assert first["episode_steps"] == 30 / 2
    assert first["contacts_per_robot"] == (2 + 3 + 1) / 4
    assert first["ir_steps_share"] == 5 / 50
    assert first["stage_success"] is None
    assert second["targets_reached"] is None
    assert second["stage_success"] == 0.5
    json.dumps([first, second], allow_nan=False)


def test_a_resumed_run_drops_what_came_after_its_checkpoint(tmp_path: Path) -> None:
    with Recorder(tmp_path, tensorboard=False, update=0) as record:
        for update in range(4):
            record.write([{"update": update, "arena_steps": update}], [], {})
        record.write([{"update": 4, "arena_steps": 4}], [{"update": 4, "why": "budget"}], {})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"update": 5, "arena')  # a crash in the middle of a line
    with Recorder(tmp_path, tensorboard=False, update=3) as record:
        record.write([{"update": 3, "arena_steps": 33}], [], {})
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["update"] for line in lines] == [0, 1, 2, 3]
    assert json.loads(lines[-1])["arena_steps"] == 33
    assert (tmp_path / "curriculum.jsonl").read_text() == ""


@pytest.mark.parametrize("wanted", [True, False])
def test_tensorboard_is_written_where_it_is_wanted(tmp_path: Path, wanted: bool) -> None:
    with Recorder(tmp_path, tensorboard=wanted, update=0) as record:
        record.write([{"update": 0, "arena_steps": 8, "return": 0.5}], [], {"speed": 2.0})
    events = list(tmp_path.glob("tensorboard/*"))
    assert bool(events) == wanted
    if wanted:
        content = events[0].read_bytes()
        assert b"return" in content
        assert b"speed" in content
