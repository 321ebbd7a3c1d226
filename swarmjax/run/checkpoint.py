"""Checkpoints hold everything that changes in a run, and a digest of their contents.

A checkpoint is a folder, `checkpoints/UPDATE`:

- Orbax writes the arrays to `state`, by names such as `learners/params/actor/mean/kernel`. Their
  first axis is the seed.
- `meta.json` has the update, the run, a digest of its config and a digest of the arrays.
- `SHA256SUMS` has a digest of each file. `sha256sum -c SHA256SUMS` checks it.

So a checkpoint that is damaged, renamed or from another run is detected, and reading falls back to
the newest sound checkpoint. Resuming restores the state of the run exactly.
"""

import functools
import hashlib
import json
import logging
import os
import re
import shutil
import sys
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.outputs import replacing
from swarmjax.policy import digest
from swarmjax.run import directory, heap, hosts
from swarmjax.run.errors import CheckpointError, TrainingError

Leaves = dict[str, np.ndarray]

KEPT = 2  # how many checkpoints are kept: the older one serves if the newest is damaged
FOLDER = hosts.CHECKPOINTS
_STATE, _META, _SUMS = "state", "meta.json", "SHA256SUMS"
_TEMPORARY = ".{}.tmp"  # the name of a folder while it is written or removed


class Kept(NamedTuple):
    """A sound checkpoint.

    Attributes:
      leaves: the arrays, as `to_leaves` returns them.
      update: number of updates that were done.
      skipped: a sentence for each newer checkpoint that is damaged.
      logs: length of each log at this checkpoint, in bytes, by name.
    """

    leaves: Leaves
    update: int
    skipped: list[str]
    logs: dict[str, int]


def path_of(run: Path, update: int) -> Path:
    """Returns the folder of a run's checkpoint."""
    return run / FOLDER / str(update)


def steps(run: Path) -> list[int]:
    """Lists the updates of a run's checkpoints, sound or not, newest first."""
    names = (path.name for path in (run / FOLDER).glob("*"))
    return sorted((int(name) for name in names if name.isdecimal()), reverse=True)


def _owner(run: Path) -> dict[str, Any]:
    """Returns the id of a run and the digest of its config; empty without a readable config."""
    try:
        stored = json.loads((run / directory.CONFIG).read_text())
        return {"run": stored["run"]["id"], "config": directory.config_digest(stored)}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return {}


class Checkpoints:
    """Writes the checkpoints of one run directory, in a `with` block.

    A thread writes the checkpoints while training continues. The `KEPT` newest ones are kept.
    """

    def __init__(self, run: Path, update: int | None = None) -> None:
        """Opens `run`/checkpoints.

        A resumed run gives the `update` that it continues from. Checkpoints of later updates were
        skipped as damaged, and are moved to `run`/passed_over.
        """
        self._run, self._owner = run, _owner(run)
        self._thread = ThreadPoolExecutor(1)
        self._pending: Future[None] | None = None
        if update is not None and hosts.is_first():
            for left in (run / FOLDER).glob(_TEMPORARY.format("*")):  # left by a killed run
                shutil.rmtree(left)
            for step in [step for step in steps(run) if step > update]:
                aside = run / "passed_over" / str(step)
                shutil.rmtree(aside, ignore_errors=True)
                aside.parent.mkdir(exist_ok=True)
                path_of(run, step).rename(aside)

    def save(self, state: Any, update: int, logs: Mapping[str, int] | None = None) -> None:
        """Starts to write a state in the thread.

        Nothing is written if the update is already saved, or if a learned number is not finite.

        Args:
          state: the training state; it is copied before this returns.
          update: number of updates that are done.
          logs: length of each log at this update, in bytes, by name.

        Raises:
          TrainingError: if the previous checkpoint could not be written.
        """
        state = hosts.gather(state)
        if not hosts.is_first():
            return
        self.wait()
        meta = {"update": update, "logs": dict(logs or {})}
        # The next call of the program overwrites the state. On a CPU, NumPy may share the state's
        # memory.
        leaves = {name: np.array(leaf) for name, leaf in to_leaves(state).items()}
        self._pending = self._thread.submit(self._write, leaves, meta)

    def wait(self) -> None:
        """Waits until the pending checkpoint is written.

        Raises:
          TrainingError: if it could not be written.
        """
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def _write(self, leaves: Leaves, meta: dict[str, Any]) -> None:
        update = meta["update"]
        try:
            if self._is_removed():  # do not make the run directory again
                raise FileNotFoundError
            if _is_sound(leaves) and update not in steps(self._run):
                self._write_folder(leaves, meta | self._owner)
                self._prune()
        except Exception as error:  # Orbax raises errors of many types
            why = f"{self._run} was removed" if self._is_removed() else _why(error)
            raise TrainingError(f"checkpoint {update} cannot be written: {why}.") from None
        heap.release()

    def _is_removed(self) -> bool:
        return bool(self._owner) and not (self._run / directory.CONFIG).exists()

    def _write_folder(self, leaves: Leaves, meta: dict[str, Any]) -> None:
        meta |= {"digest": digest(leaves)}
        folder = path_of(self._run, meta["update"])
        temporary = folder.with_name(_TEMPORARY.format(folder.name))
        shutil.rmtree(temporary, ignore_errors=True)  # left by a killed run
        temporary.mkdir(parents=True)
        try:
            with _orbax() as orbax:
                orbax.save((temporary / _STATE).resolve(), leaves)
            directory.write_json(temporary / _META, meta)
            with replacing(temporary / _SUMS) as file:
                file.write_text(_sums(temporary))
            temporary.rename(folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _prune(self) -> None:
        """Removes all checkpoints except the newest ones."""
        for step in steps(self._run)[KEPT:]:
            folder = path_of(self._run, step)
            shutil.rmtree(folder.rename(folder.with_name(_TEMPORARY.format(step))))

    def __enter__(self) -> "Checkpoints":
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Waits until everything is written."""
        try:
            self.wait()
        finally:
            self._thread.shutdown()


def _orbax() -> Any:
    """Opens a `StandardCheckpointer` that waits for no other process of the run."""
    import orbax.checkpoint as ocp  # takes a third of a second, here in the saving thread

    _silence()
    own = jax.process_index()
    return ocp.StandardCheckpointer(
        multiprocessing_options=ocp.options.MultiprocessingOptions(
            primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
        )
    )


@functools.cache
def _silence() -> None:
    """Silences Orbax's messages about a file that cannot be written, since the run says it itself.

    Orbax then closes its event loop, but TensorStore still reports the other files to this loop.
    """
    for name in ("absl", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    report = sys.unraisablehook

    def leave_out(unraisable: "sys.UnraisableHookArgs") -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            report(unraisable)

    sys.unraisablehook = leave_out


def _why(error: Exception) -> str:
    """Returns why a write failed; TensorStore gives the reason at the end of a long text."""
    code = re.search(r"os_error_code='(\d+)'", str(error))
    if code:
        return os.strerror(int(code[1]))
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return reason.splitlines()[0][:200]


def _sums(folder: Path) -> str:
    """Returns the SHA-256 of each file of a checkpoint, as the program `sha256sum` writes it."""
    lines = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != _SUMS:
            with path.open("rb") as file:
                found = hashlib.file_digest(file, "sha256")
            lines.append(f"{found.hexdigest()}  {path.relative_to(folder)}\n")
    return "".join(lines)


def _is_sound(leaves: Leaves) -> bool:
    """Returns whether all learned values are finite, so that a run can go back to this state."""
    learned = [x for name, x in leaves.items() if name.startswith("learners/")]
    return all(np.isfinite(x).all() for x in learned if np.issubdtype(x.dtype, np.floating))


def find(run: Path, update: int | None = None) -> Kept:
    """Reads a run's newest sound checkpoint, or its checkpoint of `update`.

    Args:
      run: the run directory.
      update: update of the checkpoint to read; None for the newest sound checkpoint.

    Raises:
      CheckpointError: if there is no sound checkpoint.
    """
    there = steps(run)
    if not there:
        raise CheckpointError(f"{run} has no checkpoints: give a run directory that has some.")
    if update is not None and update not in there:
        raise CheckpointError(f"{run} has no checkpoint of update {update}: give one of {there}.")
    skipped, owner = [], _owner(run)
    for step in there if update is None else [update]:
        try:
            leaves, meta = _read(path_of(run, step))
            _check(meta, step, owner)
        except Exception as error:  # damaged bytes give errors of many types
            reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
            skipped.append(f"checkpoint {step} of {run} cannot be used ({reason})")
        else:
            return Kept(leaves, step, skipped, meta["logs"])
    raise CheckpointError(f"{run} has no usable checkpoint: {'; '.join(skipped)}.")


def _read(folder: Path) -> tuple[Leaves, dict[str, Any]]:
    """Reads a checkpoint, and checks the digests of its files and arrays."""
    # Orbax refuses many damaged files too, but prints the tracebacks of its threads.
    if (folder / _SUMS).read_text() != _sums(folder):
        raise CheckpointError("its files do not match their digests")
    meta = json.loads((folder / _META).read_text())
    with _orbax() as orbax:
        leaves = orbax.restore((folder / _STATE).resolve())
    if digest(leaves) != meta["digest"]:
        raise CheckpointError("its arrays do not match their digest")
    return leaves, meta


def _check(meta: Mapping[str, Any], step: int, owner: Mapping[str, Any]) -> None:
    """Refuses a checkpoint of another update, run or config."""
    if meta["update"] != step:
        raise CheckpointError(f"it belongs to update {meta['update']}")
    found = {key: meta.get(key) for key in owner}
    if found.get("run") != owner.get("run"):
        raise CheckpointError(f"it belongs to run {found['run']}, but this is run {owner['run']}")
    if found != owner:
        raise CheckpointError(f"it was written with another {directory.CONFIG}")


def to_leaves(state: Any) -> Leaves:
    """Flattens a state to named arrays. PRNG keys become plain data; empty arrays are left out."""
    leaves = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        if leaf.size:
            leaves[_name(path)] = np.asarray(leaf)
    return leaves


def from_leaves(leaves: Leaves, template: Any) -> Any:
    """Rebuilds a state from its leaves.

    Args:
      leaves: the arrays, as `to_leaves` returns them.
      template: a state of the same structure, or its shapes from `jax.eval_shape`.

    Returns:
      The state.

    Raises:
      CheckpointError: if a leaf is missing or has another shape or type, as in another run's
        checkpoint.
    """

    def fill(path: tuple, leaf: Any) -> jax.Array:
        name, is_key = _name(path), jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        expected = jax.eval_shape(jax.random.key_data, leaf) if is_key else leaf
        if not expected.size:
            return jnp.zeros(expected.shape, expected.dtype)
        found = leaves.get(name)
        if found is None or (found.shape, found.dtype) != (expected.shape, expected.dtype):
            has = "nothing" if found is None else f"{found.dtype}{list(found.shape)}"
            raise CheckpointError(
                f"the checkpoint holds {has} for {name}, but this run's config needs "
                f"{expected.dtype}{list(expected.shape)}."
            )
        array = jnp.asarray(found)
        return jax.random.wrap_key_data(array) if is_key else array

    return jax.tree_util.tree_map_with_path(fill, template)


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")
