"""Checks the command line from end to end: train, stop, resume, export, and all refusals."""

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarmjax import command, policy, train
from swarmjax.config import build, to_dict
from swarmjax.exit_codes import INTERRUPTED
from swarmjax.export import __main__ as export
from swarmjax.export.config import ExportConfig
from swarmjax.run import checkpoint, directory, traces
from swarmjax.run.checkpoint import CheckpointError, digest
from swarmjax.run.directory import LOCK
from swarmjax.run.load_settings import load_train
from swarmjax.run.run import Run, check_free
from swarmjax.run.settings import TrainConfig

TINY = [
    "stage=s1",
    "sim.impl=jax",
    "sim.max_robots=2",
    "sim.max_obstacles=0",
    "arenas=4",
    "algo.rollout_length=4",
    "algo.num_minibatches=2",
    "algo.epochs=1",
    "algo.hidden_sizes=[8]",
    "task.step_limit=8",
    f"budget={4 * 4 * 9}",
    "run.tensorboard=false",
]


# Two stages. The first stage ends by its budget, since no policy reaches a threshold of 1.0.
SEVERAL = [
    "stage=curriculum",
    "stage.sequence=[s1,s2]",
    "curriculum.threshold=1.0",
    "seed=3",
    "seeds=2",
]


def _train(*words: str) -> int:
    return train.main([*TINY, *words])


def _digest(run: Path) -> str:
    return digest(checkpoint.find(run)[0])


def _rows(run: Path) -> list[dict]:
    """Reads the metrics of a run, without the training time."""
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(line).items() if k != "train_s"} for line in lines]


def _refusal(capsys: pytest.CaptureFixture[str], main: str, *words: str) -> str:
    """Runs a command that must be refused and returns its one sentence."""
    commands = {"train": (train.main, TrainConfig), "export": (export.main, ExportConfig)}
    run, settings = commands[main]
    before = sys.argv
    sys.argv = [main, *words]
    try:
        assert command.run(main, run, settings, (CheckpointError,)) == 2
    finally:
        sys.argv = before
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"swarmjax.{main}: error: ")
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("whole") / "run"
    assert _train(f"run.dir={run}", "run.chunk=1") == 0
    return run


def test_a_run_directory_holds_what_it_promises(whole: Path) -> None:
    names = {path.name for path in whole.iterdir()}
    promised = {"config.json", "metrics.jsonl", "summary.json", "policy.npz", "checkpoints"}
    assert promised <= names
    rows = _rows(whole)
    assert [row["update"] for row in rows] == list(range(9))
    assert rows[-1]["arena_steps"] == 4 * 4 * 9
    summary = json.loads((whole / "summary.json").read_text())
    assert summary["updates"] == 9
    assert summary["budget_spent"] is True
    assert (summary["impl"], summary["update_backend"]) == ("jax", "autodiff")
    assert summary["seeds"] == [0]
    stored = json.loads((whole / "config.json").read_text())
    assert build(TrainConfig, stored).algo.hidden_sizes == (8,)


def test_jax_is_not_loaded_before_the_settings_are_read() -> None:
    code = "import sys, swarmjax.train; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_run_with_kept_traces_gives_the_same_bits(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep, kept = traces.keep, []

    def note(program: Any, name: str, *rest: Any, **donated: Any) -> Any:
        kept.append(name)
        return keep(program, name, *rest, **donated)

    monkeypatch.setattr(traces, "keep", note)
    Run(load_train([*TINY, f"run.dir={tmp_path / 'run'}"]), keep_traces=True).train()
    assert kept == ["init", "chunk"]
    assert _digest(tmp_path / "run") == _digest(whole)


def test_a_run_imports_nothing_heavy_that_it_does_not_use() -> None:
    heavy = ("mujoco.mjx", "orbax", "scipy", "warp", "brax", "tensorboardX", "wandb", "matplotlib")
    code = f"import sys, swarmjax.run.run; sys.exit(','.join(set(sys.modules) & set({heavy!r})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr == "\n"


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Returns the lines that a short run prints, into a folder with a long name."""
    run, text = tmp_path_factory.mktemp("run") / ("long" * 20), io.StringIO()
    with contextlib.redirect_stdout(text):
        assert _train(f"run.dir={run}", "run.stop_after=1", "run.verbose=true") == 0
    return text.getvalue().splitlines()


def test_a_run_says_what_it_trains_and_then_that_it_compiles(said: list[str]) -> None:
    assert said[0].startswith("s1, 9 updates on ")
    assert said.index("building the arenas ...") < said.index("compiling ...")
    later = [line for line in said[said.index("compiling ...") + 1 :] if "still" not in line]
    assert re.fullmatch(r"compiled in .+ s", later[0])


def test_the_first_line_of_a_run_fits_100_columns(said: list[str]) -> None:
    assert len(said[0]) <= 100


def test_no_line_of_a_run_is_too_long(said: list[str]) -> None:
    # A path has a line of its own, which nothing breaks, so that it can be copied.
    assert max(len(line) for line in said if "long" * 20 not in line) <= 120


def test_the_engine_is_named_on_request(said: list[str]) -> None:
    assert "planar robots stepped by discs" in " ".join(said)


def test_the_engine_is_not_named_without_request(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _train(f"run.dir={tmp_path}", "run.stop_after=1") == 0
    assert "stepped by" not in capsys.readouterr().out


@pytest.mark.parametrize("chunk", ["7", "auto"])
@pytest.mark.slow
def test_chunks_of_any_size_train_the_same_parameters(
    chunk: str, whole: Path, tmp_path: Path
) -> None:
    assert _train(f"run.dir={tmp_path}", f"run.chunk={chunk}") == 0
    assert _digest(tmp_path) == _digest(whole)


def test_a_resumed_run_ends_where_an_uninterrupted_one_does(whole: Path, tmp_path: Path) -> None:
    assert _train(f"run.dir={tmp_path}", "run.stop_after=4") == 0
    assert checkpoint.find(tmp_path)[1] == 4
    assert train.main([f"resume={tmp_path}"]) == 0
    assert _digest(tmp_path) == _digest(whole)
    assert _rows(tmp_path) == _rows(whole)


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    """Returns a copy of a run whose budget is spent."""
    return Path(shutil.copytree(whole, tmp_path / "copied"))


def _forbid_compiling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Run, "compile", lambda _: pytest.fail("nothing to compile"))


def _contents(run: Path) -> dict[Path, tuple[bytes, int]]:
    """Returns the bytes and the modification time of every file of a run."""
    files = [path for path in run.rglob("*") if path.is_file() and path.name != LOCK]
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def test_a_run_that_is_done_says_so_and_stays_as_it_is(
    copied: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _forbid_compiling(monkeypatch)
    before = _contents(copied)
    assert train.main([f"resume={copied}"]) == 0
    said = capsys.readouterr().out
    assert "nothing left to train: the budget is spent; for more, give a larger budget\n" in said
    assert "done; evaluate the policy with:" in said
    assert _contents(copied) == before


def test_a_run_that_is_done_gets_the_summary_that_it_lacks(
    copied: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _forbid_compiling(monkeypatch)
    (copied / "summary.json").unlink()
    assert train.main([f"resume={copied}"]) == 0
    found, kept = (json.loads((run / "summary.json").read_text()) for run in (copied, whole))
    assert found == kept | {"compile_s": 0.0}


def test_a_summary_of_a_smaller_budget_is_written_anew(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _forbid_compiling(monkeypatch)
    summary = json.loads((copied / "summary.json").read_text())
    (copied / "summary.json").write_text(json.dumps(summary | {"updates": 4}))
    assert train.main([f"resume={copied}"]) == 0
    assert json.loads((copied / "summary.json").read_text())["updates"] == 9


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a run of seeds 3 and 4 on two stages; the first stage ends by its budget."""
    run = tmp_path_factory.mktemp("several") / "run"
    assert _train(*SEVERAL, f"run.dir={run}", "run.chunk=2") == 0
    return run


@pytest.mark.slow
def test_several_seeds_leave_what_each_of_them_came_to(several: Path) -> None:
    rows = _rows(several)
    assert [(row["update"], row["seed"]) for row in rows] == [
        (u, k) for u in range(9) for k in (3, 4)
    ]
    leaves = checkpoint.find(several)[0]
    assert {len(leaf) for leaf in leaves.values()} == {2}
    name = "learners/params/actor/mean/kernel"
    for lane, seed in enumerate((3, 4)):
        found = policy.load(several / f"policy-seed{seed}.npz")
        np.testing.assert_array_equal(found.layers[-1][0], leaves[name][lane])
        assert found.meta["seed"] == seed
    assert not np.array_equal(*leaves[name])
    assert not (several / "policy.npz").exists()


def test_the_summary_of_several_seeds_counts_all_of_them(several: Path) -> None:
    rows, summary = _rows(several), json.loads((several / "summary.json").read_text())
    assert summary["seeds"] == [3, 4]
    assert summary["arena_steps"] == 4 * 4 * 9  # of each seed
    transitions = sum(row["transitions"] for row in rows)
    assert summary["transitions_per_s"] == pytest.approx(transitions / summary["train_s"])
    steps = 2 * 4 * 4 * 9
    assert summary["arena_steps_per_s"] == pytest.approx(steps / summary["train_s"])
    lines = map(json.loads, (several / "curriculum.jsonl").read_text().splitlines())
    # The first stage gets half of nine updates, so it ends after the fifth.
    assert [(each["update"], each["seed"], each["from"], each["to"]) for each in lines] == [
        (4, 3, "s1", "s2"),
        (4, 4, "s1", "s2"),
    ]


@pytest.mark.slow
def test_several_seeds_resume_exactly(several: Path, tmp_path: Path) -> None:
    assert _train(*SEVERAL, f"run.dir={tmp_path}", "run.stop_after=4") == 0
    assert train.main([f"resume={tmp_path}"]) == 0
    assert _digest(tmp_path) == _digest(several)
    assert _rows(tmp_path) == _rows(several)


def test_what_is_shown_names_the_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _train(*SEVERAL, f"run.dir={tmp_path}", "run.stop_after=5") == 0
    shown = capsys.readouterr().out
    assert "seeds 3 to 4" in shown
    for seed in (3, 4):
        assert f"seed {seed}, update 5: s1 -> s2 by budget" in shown


def test_export_gives_all_seeds_or_the_one_that_is_asked_for(
    several: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = {seed: (several / f"policy-seed{seed}.npz").read_bytes() for seed in (3, 4)}
    assert export.main([f"run={several}", f"out={tmp_path / 'all.npz'}"]) == 0
    assert export.main([f"run={several}", "seed=4", f"out={tmp_path / 'one.npz'}"]) == 0
    assert set(directory.visible(tmp_path)) == {
        "all-seed3.npz",
        "all-seed4.npz",
        "one.npz",
    }
    for seed, name in ((3, "all-seed3"), (4, "all-seed4"), (4, "one")):
        found = policy.load(tmp_path / f"{name}.npz")
        kept = policy.load(several / f"policy-seed{seed}.npz")
        assert found.digest == kept.digest
        assert found.meta["seed"] == seed
    assert export.main([f"run={several}", "format=c", f"out={tmp_path / 'c'}"]) == 0
    for seed in (3, 4):
        header = (tmp_path / f"c-seed{seed}" / "policy.h").read_text()
        assert policy.load(several / f"policy-seed{seed}.npz").digest in header
    (several / "policy-seed3.npz").unlink()
    assert export.main([f"run={several}", "seed=3"]) == 0
    assert (several / "policy-seed3.npz").exists()
    capsys.readouterr()
    sentence = _refusal(capsys, "export", f"run={several}", "seed=5")
    assert f"seed is 5, but {several} was trained with seeds 3 to 4: give one of them." in sentence
    assert (several / "policy-seed4.npz").read_bytes() == first[4]


@pytest.mark.slow
def test_another_seed_is_another_run(whole: Path, tmp_path: Path) -> None:
    assert _train(f"run.dir={tmp_path}", "seed=1") == 0
    assert _digest(tmp_path) != _digest(whole)


def test_export_gives_the_policy_that_training_left(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.npz"
    assert export.main([f"run={whole}", f"out={out}"]) == 0
    with np.load(out) as again, np.load(whole / "policy.npz") as first:
        assert set(again.files) == set(first.files)
        for name in set(first.files) - {"meta"}:
            np.testing.assert_array_equal(again[name], first[name])
        assert json.loads(str(again["meta"]))["update"] == 9


def test_a_run_directory_is_never_written_over(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (whole / "metrics.jsonl").read_bytes()
    sentence = _refusal(capsys, "train", *TINY, f"run.dir={whole}")
    assert "holds a run already" in sentence
    assert (whole / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize("words", [[], ["resume=auto"]])
@pytest.mark.parametrize("name", ["policy.npz", "metrics.jsonl", "notes.txt"])
def test_a_new_run_wants_an_empty_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, words: list[str]
) -> None:
    (tmp_path / name).write_text("mine")
    assert _refusal(capsys, "train", *TINY, f"run.dir={tmp_path}", *words).endswith(
        f"run.dir is {tmp_path}, which holds {name}: give a new or an empty directory.\n"
    )
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "mine"}


def test_what_a_killed_start_leaves_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    (tmp_path / ".config.77.tmp.json").touch()
    assert directory.visible(tmp_path) == []
    check_free(tmp_path, load_train([*TINY, f"run.dir={tmp_path}"]))


@pytest.mark.slow
def test_a_resumed_run_spares_other_runs_and_what_is_spent(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    assert _train(f"run.dir={other}", "run.stop_after=1") == 0
    capsys.readouterr()
    before = (other / "config.json").read_bytes()
    sentence = _refusal(capsys, "train", f"resume={whole}", f"run.dir={other}")
    assert "a run goes on in its own directory: leave run.dir out" in sentence
    assert (other / "config.json").read_bytes() == before
    sentence = _refusal(capsys, "train", f"resume={whole}", f"budget={4 * 4 * 5}")
    assert f"has spent {4 * 4 * 9} already" in sentence


def test_foreign_and_missing_runs_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no config.json" in _refusal(capsys, "train", f"resume={tmp_path}")
    assert "no config.json" in _refusal(capsys, "export", f"run={tmp_path / 'nowhere'}")
    (tmp_path / "config.json").write_text("{")
    assert "cannot be read" in _refusal(capsys, "export", f"run={tmp_path}")
    stored = to_dict(load_train(TINY))
    (tmp_path / "config.json").write_text(json.dumps(stored))
    (tmp_path / "checkpoints" / "4").mkdir(parents=True)
    assert "no usable checkpoint" in _refusal(capsys, "train", f"resume={tmp_path}")


@pytest.mark.slow
def test_a_run_that_was_killed_before_it_saved_begins_from_its_seed(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(whole / "config.json", tmp_path)
    (tmp_path / "metrics.jsonl").write_text('{"update": 0, "arena')
    assert train.main([f"resume={tmp_path}"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"{tmp_path} has no checkpoint yet: the run begins from its seed." in said
    assert _digest(tmp_path) == _digest(whole)
    assert [row["update"] for row in _rows(tmp_path)] == list(range(9))


def test_a_checkpoint_of_another_config_is_refused(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = json.loads((whole / "config.json").read_text())
    stored["algo"]["hidden_sizes"] = [16]
    (tmp_path / "config.json").write_text(json.dumps(stored))
    (tmp_path / "checkpoints").symlink_to(whole / "checkpoints")
    sentence = _refusal(capsys, "train", f"resume={tmp_path}", "budget=160")
    assert "it was written with another config.json" in sentence


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["stage=s9"], ["s9", "s1"]),
        (["arena=4"], ["arena", "arenas"]),
        (["budget=ten"], ["budget", "ten", "whole number"]),
        (
            ["stage=s6", "stage.robots=6", "sim.max_robots=5"],
            ["stage.robots", "6", "sim.max_robots", "5"],
        ),
        (["stage=s6", "stage.side=0.5"], ["stage.side", "0.5", "at least"]),
        (["arenas=6", "algo.num_minibatches=4"], ["arenas", "6", "multiple of 4"]),
        (["seeds=0"], ["seeds", "0", "1 to 4096"]),
        (["run.dir=/proc/none"], ["run.dir", "/proc/none", "cannot be written"]),
    ],
)
def test_bad_input_is_one_sentence(
    words: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    small = TINY if words[0].startswith("run") else []
    sentence = _refusal(capsys, "train", *small, *words)
    for part in parts:
        assert part in sentence


@pytest.mark.slow
def test_an_interrupt_saves_and_says_how_to_go_on(tmp_path: Path) -> None:
    """Interrupts a process long before it has spent its budget of a million updates."""
    words = [*TINY, f"budget={4 * 4 * 10**6}", f"run.dir={tmp_path}", "run.chunk=1"]
    code = "import sys; from swarmjax import train; sys.exit(train.main(sys.argv[1:]))"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, text=True, env=os.environ
    )
    rows = tmp_path / "metrics.jsonl"
    deadline = time.monotonic() + 240.0
    while not (rows.exists() and rows.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == INTERRUPTED
    assert f"resume={tmp_path}" in output
    assert checkpoint.find(tmp_path)[1] > 0
    assert (tmp_path / "policy.npz").exists()
