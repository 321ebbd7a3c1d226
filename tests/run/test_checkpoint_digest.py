"""Checks that arrays which changed on the disk are refused, although Orbax restores them."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import orbax.checkpoint as ocp
import pytest

from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import CheckpointError, Checkpoints

Damage = Callable[[Path], None]

# Random bits cannot be compressed, so the file holds them unchanged.
WEIGHTS = np.random.default_rng(0).integers(0, 2**32, 1024, np.uint32)
FLIPPED = WEIGHTS ^ np.where(np.arange(1024) == 512, np.uint32(1), np.uint32(0))  # one bit


def _save(run: Path, weights: np.ndarray, *updates: int) -> None:
    with Checkpoints(run, keep=2) as checkpoints:
        for update in updates:
            checkpoints.save({"weights": weights, "update": np.int32(update)}, update)


def _step(run: Path, update: int) -> Path:
    return run / "checkpoints" / str(update)


def _flip_in_the_file(run: Path) -> None:
    """Flips a bit of the weights of update 2 in their file."""
    before, after = WEIGHTS[500:524].tobytes(), FLIPPED[500:524].tobytes()
    files = [path for path in _step(run, 2).rglob("*") if path.is_file()]
    (file,) = [path for path in files if before in path.read_bytes()]
    file.write_bytes(file.read_bytes().replace(before, after))


def _put_others_in_their_place(run: Path) -> None:
    """Lets Orbax write other weights for update 2, and keeps the metadata of the first weights."""
    other = run.parent / "other"
    _save(other, FLIPPED, 2)
    shutil.rmtree(_step(run, 2) / "state")
    shutil.copytree(_step(other, 2) / "state", _step(run, 2) / "state")


@pytest.fixture(params=[_flip_in_the_file, _put_others_in_their_place])
def damaged(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Returns a run with a sound checkpoint of update 1, and one of update 2 with a flipped bit.

    Like older checkpoints, the damaged one has no list of files. Only the digest of the arrays can
    reveal the damage.
    """
    run = tmp_path / "run"
    damage: Damage = request.param
    _save(run, WEIGHTS, 1, 2)
    damage(run)
    (_step(run, 2) / "files.json").unlink()
    return run


def _as_orbax_restores(run: Path, update: int) -> np.ndarray:
    with ocp.CheckpointManager((run / "checkpoints").resolve()) as manager:
        args = ocp.args.Composite(state=ocp.args.StandardRestore())
        return np.asarray(manager.restore(update, args=args)["state"]["weights"])


def test_orbax_does_not_notice_a_bit_that_changed_in_the_arrays(damaged: Path) -> None:
    """Shows why checkpoints need a digest.

    If Orbax refused these arrays, the other tests here would no longer test the digest.
    """
    np.testing.assert_array_equal(_as_orbax_restores(damaged, 2), FLIPPED)


def test_a_bit_that_changed_in_the_arrays_sends_back_to_the_sound_one(damaged: Path) -> None:
    leaves, update, skipped = checkpoint.restore(damaged)
    assert update == 1
    np.testing.assert_array_equal(leaves["weights"], WEIGHTS)
    assert len(skipped) == 1
    assert "checkpoint 2" in skipped[0]


def test_a_bit_that_changed_in_the_arrays_is_refused_where_they_are_asked_for(
    damaged: Path,
) -> None:
    with pytest.raises(CheckpointError, match="do not match its digest"):
        checkpoint.restore(damaged, 2)


def test_a_bit_that_changed_in_a_file_is_refused_before_orbax_reads_it(tmp_path: Path) -> None:
    _save(tmp_path, WEIGHTS, 1, 2)
    _flip_in_the_file(tmp_path)
    with pytest.raises(CheckpointError, match="its files do not match their digests"):
        checkpoint.restore(tmp_path, 2)


def test_a_list_of_files_that_is_damaged_is_refused(tmp_path: Path) -> None:
    _save(tmp_path, WEIGHTS, 2)
    (_step(tmp_path, 2) / "files.json").write_text("[" * 100_000)
    with pytest.raises(CheckpointError, match="its files do not match their digests"):
        checkpoint.restore(tmp_path)
