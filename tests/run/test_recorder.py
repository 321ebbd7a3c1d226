"""Checks the files that a run writes."""

import errno
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from tensorboardX.record_writer import RecordWriter

from swarmjax.run import recorder
from swarmjax.run.load_settings import load_train
from swarmjax.run.recorder import Recorder
from swarmjax.run.run import Run
from swarmjax.run.tensorboard import Boards

ONE_SEED = {
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
    "measured_floor_seen": np.array([1.5, 0.0, 0.0]),
    "stage_success": np.array([np.nan, 0.5, 0.0]),
    "success_by_stage": np.array([[np.nan, 0.25], [0.5, np.nan], [0.0, 0.0]]),
    "mix": np.array([[8, 0], [6, 2], [0, 0]]),
}
METRICS = {name: column[None] for name, column in ONE_SEED.items()}


def _row(update: int, seed: int = 0) -> dict:
    return {"update": update, "arena_steps": update, "seed": seed}


def test_rows_are_counts_with_their_shares() -> None:
    first, second = recorder.rows(METRICS, 2, ["s1", "s2"], [7], control_steps=100)
    assert first["seed"] == second["seed"] == 7
    assert first["stage"] == "s1"
    assert first["arena_steps"] == 500  # updates 0 to 4 of 100 control steps each
    assert first["targets_reached"] == 3 / 4
    assert first["all_reached"] == 1 / 2
    assert first["return"] == 2.0 / 4
    assert first["episode_steps"] == 30 / 2
    assert first["contacts_per_robot"] == (2 + 3 + 1) / 4
    assert first["ir_steps_share"] == 5 / 50
    assert first["measured_floor_seen"] == 1.5 / 2
    assert second["measured_floor_seen"] is None
    assert first["stage_success"] is None
    assert second["targets_reached"] is None
    assert second["stage_success"] == 0.5
    assert first["success_by_stage"] == [None, 0.25]
    assert second["mix"] == [6, 2]
    json.dumps([first, second], allow_nan=False)


def test_seeds_of_an_update_stand_together() -> None:
    other = ONE_SEED | {"reached": np.array([4, 0, 0]), "mix": ONE_SEED["mix"][:, ::-1]}
    metrics = {name: np.stack([ONE_SEED[name], other[name]]) for name in ONE_SEED}
    rows = recorder.rows(metrics, 2, ["s1", "s2"], range(7, 9), control_steps=100)
    assert [(row["update"], row["seed"]) for row in rows] == [(4, 7), (4, 8), (5, 7), (5, 8)]
    assert [row["targets_reached"] for row in rows] == [3 / 4, 4 / 4, None, None]
    assert [row["mix"] for row in rows] == [[8, 0], [0, 8], [6, 2], [2, 6]]
    assert [row["arena_steps"] for row in rows] == [500, 500, 600, 600]  # of each seed


def test_a_resumed_run_drops_what_came_after_its_checkpoint(tmp_path: Path) -> None:
    with Recorder(tmp_path, {}) as record:
        for update in range(3):
            record.write([_row(update)], [], {})
        logs = record.sync()
        record.write([_row(3)], [{"update": 3, "why": "budget"}], {})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"update": 5, "arena')  # a crash in the middle of a line
    with Recorder(tmp_path, logs) as record:
        record.write([_row(3) | {"arena_steps": 33}], [], {})
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["update"] for line in lines] == [0, 1, 2, 3]
    assert json.loads(lines[-1])["arena_steps"] == 33
    assert (tmp_path / "curriculum.jsonl").read_text() == ""


def test_tensorboard_gets_rows_and_speeds(tmp_path: Path) -> None:
    with Recorder(tmp_path, {}, loggers=[Boards(tmp_path, [0], [])]) as record:
        record.write([_row(0) | {"return": 0.5}], [], {"speed": 2.0})
    content = next(tmp_path.glob("tensorboard/*")).read_bytes()
    assert b"return" in content
    assert b"speed" in content


@pytest.mark.parametrize("wanted", [True, False])
def test_a_run_writes_tensorboard_where_it_is_wanted(wanted: bool) -> None:
    settings = load_train(["stage=s1", f"run.tensorboard={str(wanted).lower()}"])
    found = [logger.name for logger in Run(settings)._make_loggers()]
    assert found == (["TensorBoard"] if wanted else [])


def test_a_run_goes_on_where_tensorboard_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Acts as if TensorBoard were not installed.
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    monkeypatch.setitem(sys.modules, "tensorboardX.event_file_writer", None)
    with Recorder(tmp_path, {}, loggers=[Boards(tmp_path, [0], [])]) as record:
        for update in range(2):
            record.write([_row(update)], [], {"speed": 2.0})
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 2
    said = capsys.readouterr().err
    assert said.count("TensorBoard gets no more data") == 1


def test_several_seeds_have_a_folder_each_and_cost_what_one_does(tmp_path: Path) -> None:
    with Recorder(tmp_path, {}, loggers=[Boards(tmp_path, [3, 4], [])]) as record:
        rows = [_row(update, seed) | {f"at{update}": 1.0} for update in range(4) for seed in (3, 4)]
        record.write(rows, [], {"speed": 2.0})
    assert {path.name for path in tmp_path.glob("tensorboard/*")} == {"seed3", "seed4"}
    content = {
        seed: next(tmp_path.glob(f"tensorboard/seed{seed}/*")).read_bytes() for seed in (3, 4)
    }
    for seed in (3, 4):
        written = [update for update in range(4) if f"at{update}".encode() in content[seed]]
        assert written == [0, 2]
    assert [b"speed" in content[seed] for seed in (3, 4)] == [True, False]
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["seed"] for line in lines] == [3, 4] * 4


def test_a_run_ends_though_the_disk_was_full_for_tensorboard(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write, left = RecordWriter.write, [5]

    def until_full(self: RecordWriter, data: bytes) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, data)

    monkeypatch.setattr(RecordWriter, "write", until_full)
    with Recorder(tmp_path, {}, loggers=[Boards(tmp_path, [0], [])]) as record:
        for update in range(300):
            record.write([_row(update)], [], {"speed": 2.0})
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 300
    assert capsys.readouterr().err.count("No space left on device") == 1
