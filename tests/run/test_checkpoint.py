"""Checks that checkpoints are exact and verified, and that damaged ones are skipped."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import CheckpointError, Checkpoints
from swarmjax.run.errors import TrainingError


def _state(value: float) -> dict:
    return {
        "weights": jnp.full((2, 3), value),
        "nested": {"count": jnp.int32(7), "none": jnp.zeros((4, 0)), "flag": jnp.array([True])},
        "key": jax.random.key(5),
    }


def _save(run: Path, *updates: int) -> None:
    with Checkpoints(run) as checkpoints:
        for update in updates:
            checkpoints.save(_state(float(update)), update)


def test_a_state_comes_back_bit_for_bit(tmp_path: Path) -> None:
    _save(tmp_path, 3)
    leaves, update, skipped, *_ = checkpoint.find(tmp_path)
    state = checkpoint.from_leaves(leaves, jax.eval_shape(lambda: _state(0.0)))
    assert (update, skipped) == (3, [])
    assert {type(leaf) for leaf in leaves.values()} == {np.ndarray}
    np.testing.assert_array_equal(state["weights"], np.full((2, 3), 3.0))
    assert state["nested"]["none"].shape == (4, 0)
    assert int(state["nested"]["count"]) == 7
    assert jax.random.key_data(state["key"]).tolist() == [0, 5]


@pytest.mark.slow
def test_the_newest_are_kept_and_any_of_them_can_be_asked_for(tmp_path: Path) -> None:
    _save(tmp_path, 1, 2, 3)
    assert checkpoint.find(tmp_path)[1] == 3
    assert checkpoint.find(tmp_path, 2)[0]["weights"][0, 0] == 2.0
    with pytest.raises(CheckpointError, match=r"no checkpoint of update 1: it has \[3, 2\]"):
        checkpoint.find(tmp_path, 1)


def _flip_one_bit(folder: Path) -> None:
    """Damages the largest file of a checkpoint in the middle."""
    file = max(folder.rglob("*"), key=lambda path: path.is_file() * path.stat().st_size)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def test_a_damaged_checkpoint_is_passed_over_and_named(tmp_path: Path) -> None:
    _save(tmp_path, 1, 2)
    _flip_one_bit(checkpoint.path_of(tmp_path, 2))
    leaves, update, skipped, *_ = checkpoint.find(tmp_path)
    assert update == 1
    assert leaves["weights"][0, 0] == 1.0
    assert len(skipped) == 1
    assert "checkpoint 2" in skipped[0]


def test_nothing_sound_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="has no checkpoints"):
        checkpoint.find(tmp_path / "nowhere")
    _save(tmp_path, 4)
    _flip_one_bit(checkpoint.path_of(tmp_path, 4))
    with pytest.raises(CheckpointError, match="no usable checkpoint") as error:
        checkpoint.find(tmp_path)
    assert "\n" not in str(error.value)


def test_a_digest_notices_one_bit_and_a_name() -> None:
    leaves = {"a": np.arange(3.0), "b": np.arange(2)}
    flipped = {"a": np.nextafter(np.arange(3.0), 9.0), "b": np.arange(2)}
    assert checkpoint.digest(leaves) != checkpoint.digest(flipped)
    assert checkpoint.digest(leaves) != checkpoint.digest({"a": leaves["b"], "b": leaves["a"]})
    assert checkpoint.digest(leaves) == checkpoint.digest(dict(reversed(leaves.items())))


def test_another_run_is_refused_with_both_shapes() -> None:
    leaves = checkpoint.to_leaves(_state(1.0))
    template = jax.eval_shape(lambda: _state(0.0) | {"weights": jnp.zeros((2, 4))})
    with pytest.raises(CheckpointError, match=r"float32\[2, 3\] for weights.*float32\[2, 4\]"):
        checkpoint.from_leaves(leaves, template)
    del leaves["nested/count"]
    with pytest.raises(CheckpointError, match="nothing for nested/count"):
        checkpoint.from_leaves(leaves, jax.eval_shape(lambda: _state(0.0)))


@pytest.mark.parametrize("sound", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_going_on_replaces_what_was_damaged(tmp_path: Path, sound: int) -> None:
    _save(tmp_path, sound, 5)
    _flip_one_bit(checkpoint.path_of(tmp_path, 5))
    with Checkpoints(tmp_path, update=sound) as checkpoints:
        checkpoints.save(_state(3.0), 3)
        checkpoints.save(_state(5.0), 5)
    assert checkpoint.find(tmp_path)[1:3] == (5, [])
    assert checkpoint.find(tmp_path, 3)[0]["weights"][0, 0] == 3.0


# The run and the update that a checkpoint belongs to


def _bind(run: Path, name: str, epochs: int = 1) -> None:
    run.mkdir(parents=True, exist_ok=True)
    stored = {"algo": {"epochs": epochs}, "budget": 5, "run": {"id": name}}
    (run / "config.json").write_text(json.dumps(stored))


def test_a_renamed_checkpoint_is_passed_over(tmp_path: Path) -> None:
    _save(tmp_path, 1, 2)
    checkpoint.path_of(tmp_path, 2).rename(checkpoint.path_of(tmp_path, 7))
    _, update, skipped, *_ = checkpoint.find(tmp_path)
    assert update == 1
    assert "checkpoint 7" in skipped[0]
    assert "it belongs to update 2" in skipped[0]


@pytest.mark.slow
def test_swapped_checkpoints_are_both_passed_over(tmp_path: Path) -> None:
    _save(tmp_path, 1, 2)
    first, second = (checkpoint.path_of(tmp_path, step) for step in (1, 2))
    aside = second.rename(tmp_path / "aside")
    first.rename(second)
    aside.rename(first)
    with pytest.raises(CheckpointError, match="no usable checkpoint"):
        checkpoint.find(tmp_path)


def test_a_checkpoint_of_another_run_is_passed_over(tmp_path: Path) -> None:
    mine, other = tmp_path / "mine", tmp_path / "other"
    for run, name in ((mine, "a"), (other, "b")):
        _bind(run, name)
        _save(run, 1)
    _save(other, 2)
    shutil.copytree(checkpoint.path_of(other, 2), checkpoint.path_of(mine, 2))
    _, update, skipped, *_ = checkpoint.find(mine)
    assert update == 1
    assert "it belongs to run b, but this is run a" in skipped[0]


def test_a_checkpoint_of_another_config_is_refused(tmp_path: Path) -> None:
    _bind(tmp_path, "a", epochs=1)
    _save(tmp_path, 1)
    _bind(tmp_path, "a", epochs=2)
    with pytest.raises(CheckpointError, match=r"it was written with another config\.json"):
        checkpoint.find(tmp_path)


@pytest.mark.slow
def test_the_bytes_of_the_logs_come_back(tmp_path: Path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(_state(1.0), 1, {"metrics.jsonl": 17})
    kept = checkpoint.find(tmp_path)
    assert kept.logs == {"metrics.jsonl": 17}


def test_a_state_is_copied_before_the_run_goes_on(tmp_path: Path) -> None:
    state = {"weights": np.zeros((1000, 1000))}
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(state, 1)
        state["weights"][:] = 1.0  # as the next call does to a donated state
    assert not checkpoint.find(tmp_path)[0]["weights"].any()


# A program that saves while files are limited to 2,000 bytes, as on a full disk.
_FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from swarmjax.run import checkpoint
state = {f"a{i}": np.random.default_rng(i).random(500) for i in range(40)}
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
try:
    with checkpoint.Checkpoints(Path(sys.argv[1])) as checkpoints:
        checkpoints.save(state, 0)
except checkpoint.TrainingError as error:
    print(error)
"""


@pytest.mark.slow
def test_a_disk_that_is_full_is_one_sentence(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _FULL, str(tmp_path)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.stdout.startswith("checkpoint 0 cannot be written: ")
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


def test_what_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").write_text("a file in the place of the folder")
    with (
        pytest.raises(TrainingError, match="checkpoint 1 cannot be written: ") as error,
        Checkpoints(tmp_path) as checkpoints,
    ):
        checkpoints.save(_state(1.0), 1)
    assert "\n" not in str(error.value)


def test_a_directory_that_was_removed_is_named_and_not_made_again(tmp_path: Path) -> None:
    run = tmp_path / "run"
    _bind(run, "a")
    named = pytest.raises(TrainingError, match=r"checkpoint 2 .* written: .*run was removed\.")
    with named, Checkpoints(run) as checkpoints:
        checkpoints.save(_state(1.0), 1)
        checkpoints.wait()
        shutil.rmtree(run)
        checkpoints.save(_state(2.0), 2)
    assert not run.exists()


def _fail(_: Path) -> str:
    raise OSError


def test_an_unfinished_checkpoint_is_not_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _save(tmp_path, 1)
    monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)  # as if the run were killed
    monkeypatch.setattr(checkpoint, "_sums", _fail)
    with pytest.raises(TrainingError, match="checkpoint 2 cannot be written"):
        _save(tmp_path, 2)
    monkeypatch.undo()
    assert checkpoint.find(tmp_path)[1:3] == (1, [])
    again = tmp_path / "again" / "checkpoints"
    shutil.copytree(tmp_path / "checkpoints", again)
    _save(again.parent, 2)
    assert checkpoint.find(again.parent)[1:3] == (2, [])
    Checkpoints(tmp_path, update=1)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["1"]


# The digests of the files, and that of the arrays, if somebody made the list of the files anew


def _sign(folder: Path) -> None:
    (folder / "SHA256SUMS").write_text(checkpoint._sums(folder))


def test_the_list_of_digests_is_that_of_sha256sum(tmp_path: Path) -> None:
    _save(tmp_path, 1)
    words = ["sha256sum", "--strict", "-c", "SHA256SUMS"]
    subprocess.run(words, cwd=checkpoint.path_of(tmp_path, 1), check=True, capture_output=True)


@pytest.mark.parametrize("name", ["meta.json", "SHA256SUMS", "state/_METADATA"])
def test_every_file_is_checked(tmp_path: Path, name: str) -> None:
    _save(tmp_path, 1, 2)
    (checkpoint.path_of(tmp_path, 2) / name).unlink()
    assert checkpoint.find(tmp_path)[1] == 1
    with pytest.raises(CheckpointError, match=r"checkpoint 2 .*(do not match|No such file)"):
        checkpoint.find(tmp_path, 2)


def test_one_bit_of_the_arrays_sends_back_to_the_sound_checkpoint(tmp_path: Path) -> None:
    _save(tmp_path, 1, 2)
    weights = np.full((2, 3), 2.0, np.float32)
    weights.view(np.uint32)[1, 1] ^= 1
    with Checkpoints(tmp_path / "changed") as checkpoints:
        checkpoints.save(_state(2.0) | {"weights": jnp.asarray(weights)}, 2)
    folder = checkpoint.path_of(tmp_path, 2)
    shutil.rmtree(folder / "state")
    shutil.copytree(checkpoint.path_of(tmp_path / "changed", 2) / "state", folder / "state")
    _sign(folder)
    leaves, update, skipped, *_ = checkpoint.find(tmp_path)
    assert update == 1
    np.testing.assert_array_equal(leaves["weights"], np.full((2, 3), 1.0))
    assert len(skipped) == 1
    with pytest.raises(CheckpointError, match=r"checkpoint 2 .*arrays do not match their digest"):
        checkpoint.find(tmp_path, 2)
