"""Checks that a run survives kills, signals, a full disk, and a second start."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import extensions
import jax
import numpy as np
import pytest

from swarmjax import train
from swarmjax.config import ConfigError
from swarmjax.exit_codes import FAILED, REQUEUE
from swarmjax.policy import digest
from swarmjax.run import checkpoint, directory
from swarmjax.run import run as runs
from swarmjax.run.compiled import Compiled
from swarmjax.run.directory import LOCK
from swarmjax.run.load_settings import load_run
from swarmjax.run.settings import RunConfig

TINY = [
    "stage=s1",
    "arenas=4",
    "budget=144",  # nine updates
    "task.step_limit=8",
    "algo.rollout_length=4",
    "algo.num_minibatches=2",
    "algo.hidden_sizes=[8]",
    "run.tensorboard=false",
]
_CODE = "import sys; from swarmjax import train; sys.exit(train.main(sys.argv[1:]))"


@pytest.fixture(autouse=True, scope="module")
def _compiled_once() -> Iterator[None]:
    """Compiles each program once, since no test here is about compiling."""
    compile_chunk, found = runs.compile_chunk, {}

    def look_up(program: Any, *arguments: Any, **options: Any) -> Compiled:
        config = replace(program.config, run=RunConfig(), resume=None)
        key = (repr(config), program.by_robot)
        if key not in found:
            found[key] = compile_chunk(program, *arguments, **options)
        return found[key]

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(runs, "compile_chunk", look_up)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("whole") / "run"
    assert train.main([*TINY, f"run.dir={run}"]) == 0
    return run


def _digest(run: Path) -> str:
    return digest(checkpoint.find(run)[0])


def _updates(run: Path) -> list[int]:
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["update"] for line in lines]


def _stopped(run: Path, after: int) -> Path:
    assert train.main([*TINY, f"run.dir={run}", f"run.stop_after={after}"]) == 0
    return run


def _start(words: Sequence[str]) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", _CODE, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ,
    )


def _wait_for(path: Path) -> None:
    deadline = time.monotonic() + 240.0
    while not (path.exists() and path.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.05)


def test_a_finished_run_keeps_its_newest_checkpoints(whole: Path) -> None:
    newest, *older = checkpoint.steps(whole)
    assert (newest, len(older)) == (9, 1)


@pytest.mark.slow
def test_the_first_checkpoint_comes_before_the_first_update(tmp_path: Path) -> None:
    _stopped(tmp_path / "run", after=1)
    assert checkpoint.steps(tmp_path / "run") == [1, 0]


def _kill_while_opening(run: Path, torn: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Resumes a run, and interrupts it while it opens one of its files.

    Args:
      run: The run to resume.
      torn: Name of the file. If the run writes this file in place, it writes only half of the text.
      monkeypatch: Sets the interrupts; it is undone at the end.
    """
    replaced, written = Path.replace, Path.write_text

    def die(self: Path, target: Path) -> Path:
        if Path(target).name == torn:
            raise KeyboardInterrupt
        return replaced(self, target)

    def tear(self: Path, text: str, *given: Any, **named: Any) -> int:
        if self.name == torn:
            written(self, text[: len(text) // 2])
            raise KeyboardInterrupt
        return written(self, text, *given, **named)

    monkeypatch.setattr(Path, "replace", die)
    monkeypatch.setattr(Path, "write_text", tear)
    monkeypatch.setattr(directory, "cut", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train.main([f"resume={run}"])
    monkeypatch.undo()


@pytest.mark.parametrize("torn", ["config.json", "metrics.jsonl"])
@pytest.mark.slow
def test_a_resume_that_is_killed_while_it_opens_its_files_loses_nothing(
    torn: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = _stopped(tmp_path / "run", after=5)
    before = (run / torn).read_bytes()
    _kill_while_opening(run, torn, monkeypatch)
    assert (run / torn).read_bytes() == before
    assert train.main([f"resume={run}"]) == 0
    assert _digest(run) == _digest(whole)
    assert _updates(run) == list(range(9))


@pytest.mark.slow
def test_a_resume_that_is_killed_while_it_opens_its_decisions_loses_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    words = [*TINY, "stage=curriculum", "stage.sequence=[s1,s2]", f"run.dir={run}"]
    assert train.main([*words, "run.stop_after=7"]) == 0
    before = (run / "curriculum.jsonl").read_bytes()
    assert b'"budget"' in before
    _kill_while_opening(run, "curriculum.jsonl", monkeypatch)
    assert (run / "curriculum.jsonl").read_bytes() == before
    assert train.main([f"resume={run}"]) == 0
    assert (run / "curriculum.jsonl").read_bytes().startswith(before)


def test_rows_after_the_checkpoint_are_not_doubled(whole: Path, tmp_path: Path) -> None:
    run = _stopped(tmp_path / "run", after=5)
    with (run / "metrics.jsonl").open("a") as file:  # of a call that saved no checkpoint
        file.write('{"update": 5, "seed": 0}\n{"update": 6, "se')
    assert train.main([f"resume={run}"]) == 0
    assert _updates(run) == list(range(9))
    assert _digest(run) == _digest(whole)


@pytest.mark.slow
def test_episodes_stay_where_a_run_writes_none_for_a_while(tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert train.main([*TINY, f"run.dir={run}", "run.episodes=true", "run.stop_after=4"]) == 0
    written = (run / "episodes.jsonl").read_bytes()
    assert train.main([f"resume={run}", "run.episodes=false", "run.stop_after=6"]) == 0
    assert train.main([f"resume={run}"]) == 0
    assert written
    assert (run / "episodes.jsonl").read_bytes().startswith(written)


def test_checkpoints_without_their_config_are_not_added_to(tmp_path: Path) -> None:
    run = _stopped(tmp_path / "run", after=5)
    (run / "config.json").unlink()
    with pytest.raises(ConfigError, match="which holds checkpoints"):
        train.main([*TINY, f"run.dir={run}"])


@pytest.mark.slow
def test_a_signal_of_a_scheduler_saves_and_asks_for_a_requeue(tmp_path: Path) -> None:
    process = _start([*TINY, f"budget={16 * 10**7}", f"run.dir={tmp_path}", "run.chunk=1"])
    _wait_for(tmp_path / "metrics.jsonl")
    began = time.monotonic()
    process.send_signal(signal.SIGUSR1)
    said, _ = process.communicate(timeout=120)
    assert time.monotonic() - began < 60.0  # nearly all of this is for a busy machine
    assert process.returncode == REQUEUE
    assert f"resume={tmp_path}" in said
    done = checkpoint.find(tmp_path)[1]
    assert _updates(tmp_path) == list(range(done))


def test_a_signal_while_jax_loads_ends_with_a_sentence(tmp_path: Path) -> None:
    process = _start([*TINY, f"run.dir={tmp_path / 'run'}"])
    time.sleep(1.0)
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == REQUEUE
    assert "stopped before the first update" in said
    assert "Traceback" not in said
    assert directory.visible(tmp_path / "run") == []


@pytest.mark.slow
def test_two_processes_do_not_write_one_run(tmp_path: Path) -> None:
    first = _start([*TINY, f"budget={16 * 10**7}", f"run.dir={tmp_path}"])
    _wait_for(tmp_path / "metrics.jsonl")
    try:
        with pytest.raises(ConfigError, match=f"process {first.pid} is writing"):
            train.main([f"resume={tmp_path}", "run.stop_after=1"])
        with pytest.raises(ConfigError, match="holds a run already"):
            train.main([*TINY, f"run.dir={tmp_path}"])
    finally:
        first.kill()
        first.communicate()


def test_two_new_runs_do_not_begin_in_one_directory(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with directory.locked(run):  # like a run that still compiles and has written no other file
        assert os.listdir(run) == [LOCK]
        with pytest.raises(ConfigError, match=f"process {os.getpid()} is writing"):
            train.main([*TINY, f"run.dir={run}"])
    assert train.main([*TINY, f"run.dir={run}", "run.stop_after=1"]) == 0


def _full(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Makes the disk appear full after this many writes to logs."""
    write, left = directory.Log.write, [after]

    def until_full(self: directory.Log, rows: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        write(self, rows)

    monkeypatch.setattr(directory.Log, "write", until_full)


@pytest.mark.parametrize(
    "after", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (0, 2, 9))]
)
def test_a_full_disk_is_one_sentence_and_the_run_goes_on_later(
    after: int,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    _full(monkeypatch, after)
    assert train.main([*TINY, f"run.dir={run}", "run.chunk=1"]) == 1
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert f"What was saved before is in {run}" in said
    monkeypatch.undo()
    assert train.main([f"resume={run}"]) == 0
    assert _digest(run) == _digest(whole)


# To resume a run, or to begin one


@pytest.mark.slow
def test_auto_begins_and_then_goes_on(whole: Path, tmp_path: Path) -> None:
    words = [*TINY, f"run.dir={tmp_path}", "resume=auto"]
    assert train.main([*words, "run.stop_after=4"]) == 0
    assert train.main(words) == 0
    assert _digest(tmp_path) == _digest(whole)
    assert _updates(tmp_path) == list(range(9))


@pytest.mark.slow
def test_auto_takes_a_larger_budget(tmp_path: Path) -> None:
    words = [*TINY, f"run.dir={tmp_path}", "resume=auto"]
    assert train.main(words) == 0
    assert train.main([*words, "budget=160"]) == 0
    assert checkpoint.find(tmp_path)[1] == 10


def test_auto_refuses_other_settings_key_by_key(whole: Path) -> None:
    words = [*TINY, f"run.dir={whole}", "resume=auto", "algo.discount=0.9", "seed=3"]
    with pytest.raises(ConfigError) as error:
        load_run(words)
    assert "algo.discount is 0.9, not 0.998" in str(error.value)
    assert "seed is 3, not 0" in str(error.value)
    assert "only budget, devices, resume, run.*, streams" in str(error.value)


def test_auto_needs_a_directory() -> None:
    with pytest.raises(ConfigError, match=r"resume is auto, but run\.dir is missing: give"):
        load_run([*TINY, "resume=auto"])


def test_a_finished_run_stays_as_it_is_by_auto(whole: Path) -> None:
    files = [path for path in whole.rglob("*") if path.is_file() and path.name != LOCK]
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}
    assert train.main([*TINY, f"run.dir={whole}", "resume=auto"]) == 0
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files} == before


@pytest.mark.parametrize("lost", ["metrics.jsonl", "curriculum.jsonl"])
def test_a_log_that_was_cut_is_refused_with_what_to_do(lost: str, tmp_path: Path) -> None:
    run = _stopped(tmp_path / "run", after=5)
    text = (run / "metrics.jsonl").read_text()
    (run / "metrics.jsonl").write_text(text[: len(text) // 2])
    with pytest.raises(ValueError, match="restore the file, or delete it to continue"):
        train.main([f"resume={run}"])
    (run / "metrics.jsonl").unlink()
    assert train.main([f"resume={run}"]) == 0
    assert _updates(run) == list(range(5, 9))


def test_a_directory_that_is_removed_while_a_run_trains_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    run, save = tmp_path / "run", checkpoint.Checkpoints.save

    def remove_before(self: Any, state: Any, update: int, *given: Any, **named: Any) -> None:
        if update:
            self.wait()
            shutil.rmtree(run, ignore_errors=True)
        save(self, state, update, *given, **named)

    monkeypatch.setattr(checkpoint.Checkpoints, "save", remove_before)
    assert train.main([*TINY, f"run.dir={run}", "run.chunk=1"]) == FAILED
    said = capfd.readouterr().err
    assert re.search(rf"error: checkpoint \d cannot be written: {run} was removed\.\n$", said)
    assert said.count("\n") == 1


# Numbers that are not finite


def _spoil(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """Sets the optimiser's state of a run's last seed to NaN, after `at` updates."""
    compile_chunk, left = runs.compile_chunk, [1]

    def broken(x: jax.Array) -> jax.Array:
        return x.at[-1].set(np.nan) if x.dtype == np.float32 else x

    def compile_and_spoil(*arguments: Any, **options: Any) -> Any:
        compiled = compile_chunk(*arguments, **options)

        def spoil(schedule: Any, state: Any, n: Any) -> Any:
            state, metrics = compiled.call(schedule, state, n)
            if left[0] and int(state.update[0]) >= at:
                left[0] -= 1
                learners = state.learners
                found = jax.tree.map(broken, learners.optimizer_state)
                state = replace(state, learners=replace(learners, optimizer_state=found))
            return state, metrics

        return replace(compiled, call=spoil)

    monkeypatch.setattr(runs, "compile_chunk", compile_and_spoil)


@pytest.mark.slow
def test_a_run_that_diverges_ends_and_keeps_its_last_sound_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _spoil(monkeypatch, at=5)
    words = [*TINY, "budget=640", "run.chunk=1", "seeds=2", f"run.dir={tmp_path}"]
    assert train.main(words) == FAILED
    said = capsys.readouterr().err
    assert "no gradient step of seed 1 was finite in 10 updates up to update 15: give lower" in said
    assert f"What was saved before is in {tmp_path}." in said
    assert checkpoint.find(tmp_path).update == 4


@pytest.mark.slow
def test_a_run_that_stops_before_it_has_diverged_names_the_last_sound_update(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _spoil(monkeypatch, at=5)
    words = [*TINY, "budget=640", "run.chunk=1", "seeds=2", f"run.dir={tmp_path}"]
    assert train.main([*words, "run.stop_after=8"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "stopped after update 8 of 40, saved at update 4, the last sound one" in said


@pytest.mark.slow
def test_a_run_whose_arenas_all_break_stops_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body = "@reward_term(weight=1.0)\ndef broken(step):\n    return jnp.nan * step.action[:, 0]\n"
    mine = extensions.write(tmp_path / "mine.py", body)
    words = [*TINY, "budget=640", f"extensions={mine}", f"run.dir={tmp_path / 'run'}"]
    assert train.main(words) == FAILED
    said = capsys.readouterr().err
    assert "every arena broke at every step in 10 updates up to update 10" in said
