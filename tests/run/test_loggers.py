"""Checks that loggers get the rows of `metrics.jsonl`, and that a failed logger stops no run."""

import contextlib
import importlib.util
import io
import json
import struct
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from tensorboardX.proto import event_pb2

import swarmjax
from swarmjax import train
from swarmjax.config import ConfigError
from swarmjax.run import loggers
from swarmjax.run.loggers import Guarded
from swarmjax.run.tensorboard import numbers
from swarmjax.task.stage_config import StageConfig

STAGES = ["pair", "trio"]
TINY = {
    "stage": [
        StageConfig(name=name, robots=robots, side=0.5) for robots, name in enumerate(STAGES, 2)
    ],
    "sim.impl": "jax",
    "arenas": 16,
    "algo": {"rollout_length": 4, "num_minibatches": 2, "epochs": 1, "hidden_sizes": [8]},
    "task.step_limit": 8,
    "budget": 16 * 4 * 8,
    "run.chunk": 2,
}
HAS_WANDB = getattr(importlib.util.find_spec("wandb"), "origin", None) is not None


class Listening:
    """A logger that records each of its calls and the thread of the call."""

    name = "Listening"

    def __init__(self) -> None:
        self.told: list[tuple[str, Any, int]] = []

    def _keep(self, what: str, found: Any) -> None:
        self.told.append((what, found, threading.get_ident()))

    def write(self, rows: Any, speeds: Any) -> None:
        self._keep("write", (rows, speeds))

    def close(self) -> None:
        self._keep("close", None)


class Broken(Listening):
    """A logger that raises an error at its second call."""

    name = "Broken"

    def write(self, rows: Any, speeds: Any) -> None:
        super().write(rows, speeds)
        if len(self.told) == 2:
            raise SystemExit("enough")


class Told:
    """A run with every kind of logger, and the calls that they got."""

    def __init__(self, run: Path) -> None:
        self.listening, self.broken = Listening(), Broken()
        self.seen: list[int] = []
        more = {"run.wandb": "swarms"} if HAS_WANDB else {}
        offline = pytest.MonkeyPatch.context()
        with offline as patch, contextlib.redirect_stderr(io.StringIO()) as said:
            patch.setenv("WANDB_MODE", "offline")
            self.result = swarmjax.train_policy(
                TINY | more | {"run.dir": run},
                log=[self.broken, self.listening],
                on_update=self._stop,
            )
        self.said = said.getvalue()
        self.run = run
        self.rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]

    def _stop(self, row: dict) -> bool:
        """Stops the run after its sixth update; its budget is eight."""
        self.seen.append(row["update"])
        return row["update"] == 5


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Told:
    return Told(tmp_path_factory.mktemp("told") / "run")


def _numbers(row: dict) -> dict[str, float]:
    """Returns the numbers of a row; that of a stage has the name of its list, a slash, its name."""
    found: dict[str, float] = {k: v for k, v in row.items() if isinstance(v, int | float)}
    for name in (k for k, v in row.items() if isinstance(v, list)):
        parts = zip(STAGES, row[name], strict=True)
        found |= {f"{name}/{stage}": v for stage, v in parts if v is not None}
    return found


def _events(file: Path) -> Iterator[Any]:
    """Reads a file of TFRecords.

    Each record is a length, a checksum of the length, the bytes, and a checksum of the bytes.
    """
    content, at, made = file.read_bytes(), 0, event_pb2
    while at < len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        yield vars(made)["Event"].FromString(content[at + 12 : at + 12 + length])
        at += 16 + length


def _scalars(folder: Path) -> list[tuple[int, dict[str, float]]]:
    """Returns the step and the numbers of each event in a TensorBoard folder."""
    (file,) = folder.iterdir()
    return [
        (event.step, {each.tag: each.simple_value for each in event.summary.value})
        for event in _events(file)
        if event.summary.value
    ]


def test_a_callback_sees_every_update_and_stops_the_run(told: Told) -> None:
    result = told.result
    assert told.seen == [row["update"] for row in result.metrics] == [*range(6)]
    assert result.run == told.run
    assert result.policy.digest == swarmjax.load_policy(told.run / "policy.npz").digest
    assert result.policy.meta["update"] == 6


def test_tensorboard_has_the_numbers_of_the_record(told: Told) -> None:
    found = [each for each in _scalars(told.run / "tensorboard") if "update" in each[1]]
    expected = [
        # TensorBoard stores numbers as float32.
        (row["arena_steps"], {k: float(np.float32(v)) for k, v in _numbers(row).items()})
        for row in told.rows
    ]
    assert found == expected


def test_speeds_are_told_with_the_rows_of_their_call(told: Told) -> None:
    calls = [found for what, found, _ in told.listening.told if what == "write"]
    assert [row for rows, _ in calls for row in rows] == told.rows
    assert all(speeds["arena_steps_per_s"] > 0 for _, speeds in calls)


def test_a_logger_is_called_from_one_thread_that_is_not_the_runs(told: Told) -> None:
    threads = {thread for _, _, thread in told.listening.told}
    assert len(threads) == 1
    assert threads != {threading.get_ident()}


def test_a_logger_is_closed_once_and_last(told: Told) -> None:
    whats = [what for what, _, _ in told.listening.told]
    assert whats[-1] == "close"
    assert whats.count("close") == 1


@pytest.mark.skipif(not HAS_WANDB, reason="needs the extra wandb")
def test_wandb_offline_has_the_numbers_of_the_record(told: Told) -> None:
    (file,) = told.run.glob("wandb/offline-run-*/run-*.wandb")
    found = [
        {name: value for name, value in row.items() if name.split("/")[0] in told.rows[0]}
        for row in _histories(file)
    ]
    assert found == [_numbers(row) for row in told.rows]


def _histories(file: Path) -> Iterator[dict]:
    """Reads the rows of an offline W&B run, which is a LevelDB log after a header of 7 bytes."""
    from wandb.proto import wandb_internal_pb2 as made  # pyright: ignore[reportMissingImports]

    content, at, part, block = file.read_bytes(), 7, b"", 2**15
    while at + 7 <= len(content):
        if block - at % block < 7:
            at += block - at % block
            continue
        length, kind = struct.unpack_from("<HB", content, at + 4)
        part += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # a whole record, or the last part of one
            record, part = made.Record.FromString(part), b""
            if record.WhichOneof("record_type") == "history":
                items = record.history.item
                yield {i.key or "/".join(i.nested_key): json.loads(i.value_json) for i in items}


def test_a_logger_that_raises_loses_itself_and_not_the_run(told: Told) -> None:
    assert [what for what, _, _ in told.broken.told] == ["write", "write", "close"]
    assert told.said == "swarmjax: Broken gets no more data: SystemExit: enough.\n"


@pytest.mark.slow
def test_a_run_that_goes_on_tells_what_comes_after_its_checkpoint(told: Told) -> None:
    log = Listening()
    more = {"run.tensorboard": False, "run.wandb": None}
    swarmjax.train_policy({"resume": told.run} | more, log=[log])
    calls = [found for what, found, _ in log.told if what == "write"]
    assert [row["update"] for rows, _ in calls for row in rows] == [6, 7]


def test_a_logger_that_does_not_end_is_left_behind(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(loggers, "PATIENCE_S", 0.05)
    for_ever, logger = threading.Event(), Listening()
    monkeypatch.setattr(logger, "write", lambda *_: for_ever.wait())
    guarded = Guarded(logger)
    guarded.write([{"update": 0}], {})
    guarded.close()
    for_ever.set()
    assert "Listening gets no more data: it has not finished" in capsys.readouterr().err


def test_numbers_of_a_stage_have_its_name() -> None:
    row = {"update": 3, "stage": "s2", "success_by_stage": [0.5, None, 0.25]}
    expected = {"update": 3, "success_by_stage/s1": 0.5, "success_by_stage/s3": 0.25}
    assert numbers(row, ["s1", "s2", "s3"]) == expected


@pytest.mark.parametrize("folder", [False, True])
def test_wandb_that_is_missing_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: bool
) -> None:
    # W&B writes a folder `wandb`, which Python imports as a package without code.
    monkeypatch.setitem(sys.modules, "wandb", ModuleType("wandb") if folder else None)
    words = ["stage=s1", f"run.dir={tmp_path / 'run'}", "run.wandb=swarms"]
    with pytest.raises(ConfigError, match=r"^run\.wandb is 'swarms', .*install the extra wandb"):
        train.main(words)
    assert not any(tmp_path.iterdir())
