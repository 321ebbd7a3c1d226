"""Checkpoints hold everything that changes in a run, and a digest of their contents.

Resuming is exact.

Orbax writes the steps. This module adds three things that Orbax lacks:

- A digest detects damage. Without it, Orbax restores a flipped bit silently.
- Each step records its update, config and run, so that a swapped, renamed or foreign step is
  detected.
- Reading falls back to the newest sound step.

A checkpoint is a flat dictionary from names such as `learners/params/actor/mean/kernel` to arrays.
So it can be read without the program that wrote it. The arrays of a run have a leading axis of
seeds.
"""

import errno
import functools
import hashlib
import json
import logging
import os
import shutil
import sys
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import logging as absl_logging

from swarmjax.policy import digest
from swarmjax.run import directory, heap, hosts
from swarmjax.run.errors import CheckpointError, TrainingError

# Importing Orbax takes half a second. A run imports it while XLA compiles (`trainer`).
if TYPE_CHECKING:
    import orbax.checkpoint as ocp

Leaves = dict[str, np.ndarray]

FOLDER = hosts.CHECKPOINTS
ARENAS = "arenas/"  # prefix of the arenas' leaves
_OLD_META = {"digest", "update"}  # all metadata in older checkpoints, which do not name their run
# The SHA-256 of each file of a step. Orbax fails on damaged files too, but prints the tracebacks
# of its threads.
_MANIFEST = "files.json"
# Seconds, at most, between the removal of a directory's checkpoints and of its config.
_REMOVAL = 0.5
_UNFINISHED = "*.orbax-checkpoint-tmp*"  # Orbax renames such a folder when it is complete


class Binding(NamedTuple):
    """The run and config that a checkpoint belongs to.

    Attributes:
      run: id of the run; None in older versions, whose runs had no id.
      config: digest of the config's fixed keys.
    """

    run: str | None
    config: str


class Kept(NamedTuple):
    """A sound checkpoint.

    Attributes:
      leaves: the arrays, as `to_leaves` gave them.
      update: updates that were done.
      logs: bytes of each log at this checkpoint, by name; empty in older checkpoints.
      rate_scale: factor on the learning rates.
      skipped: a sentence for each newer checkpoint that is damaged.
      notes: sentences about what this checkpoint does not record.
    """

    leaves: Leaves
    update: int
    logs: dict[str, int]
    rate_scale: float
    skipped: list[str]
    notes: list[str]

    @property
    def has_arenas(self) -> bool:
        """Whether the checkpoint holds the arenas. If not, a resumed run draws new arenas."""
        return any(name.startswith(ARENAS) for name in self.leaves)


def binding(run: Path) -> Binding | None:
    """Reads the binding that a run directory's checkpoints must have; None without a config."""
    try:
        stored = json.loads((run / directory.CONFIG).read_text())
        return Binding(stored.get("run", {}).get("id"), directory.config_digest(stored))
    except (OSError, ValueError, AttributeError, RecursionError):
        return None


class Checkpoints:
    """Writes the checkpoints of one run directory, in a `with` block.

    A thread writes them while training continues. The newest checkpoints and the one with the
    highest score are kept.

    Attributes:
      write_seconds: time to write the newest checkpoint.
    """

    def __init__(self, run: Path, keep: int, update: int | None = None) -> None:
        """Opens `run`/checkpoints, to keep the `keep` newest.

        A resumed run gives the `update` that it continues from. Checkpoints after `update` were
        skipped as damaged. They are moved aside, because Orbax would save no update that comes
        before theirs. Nothing else is done until the first save, so that a run need not wait for
        Orbax to begin.
        """
        self._run, self._keep = run, keep
        self._folder = (run / FOLDER).resolve()
        self._binding = binding(run)
        self._thread = ThreadPoolExecutor(1)
        self._pending: Future[None] | None = None
        self.write_seconds = 0.0
        if update is not None and hosts.is_first():
            for left in self._folder.glob(_UNFINISHED):
                shutil.rmtree(left, ignore_errors=True)
            for step in steps(run):
                if step > update:
                    _put_aside(self._folder / str(step))
            directory.cut_rows(run / directory.SAVED, update + 1)

    @functools.cached_property
    def _manager(self) -> "ocp.CheckpointManager":
        import orbax.checkpoint as ocp

        _quieten()
        self._folder.mkdir(parents=True, exist_ok=True)
        return ocp.CheckpointManager(self._folder, options=_options())

    def save(
        self,
        state: Any,
        update: int,
        logs: Mapping[str, int] | None = None,
        score: float | None = None,
        rate_scale: float = 1.0,
        of: Mapping[str, Any] | None = None,
    ) -> None:
        """Begins to write a state.

        Does nothing if the update is already saved, or if what was learned is not finite.

        Args:
          state: the training state; it is copied before this returns.
          update: updates that are done.
          logs: bytes of each log at this update, by name.
          score: rates the checkpoint, higher is better; None if unknown.
          rate_scale: factor on the learning rates.
          of: further entries for the checkpoint's row in the list of checkpoints.

        Raises:
          TrainingError: if the previous checkpoint could not be written.
        """
        state = hosts.gather(state)
        if not hosts.is_first():
            return
        self.wait()
        meta = {"update": update, "logs": dict(logs or {}), "rate_scale": rate_scale}
        told = {"score": score, "rate_scale": rate_scale, **(of or {})}
        # The next call of the program overwrites the state. On a CPU, NumPy may share the state's
        # memory.
        leaves = {name: np.array(leaf) for name, leaf in to_leaves(state).items()}
        self._pending = self._thread.submit(self._write, leaves, meta, told)

    def wait(self) -> None:
        """Waits until the pending checkpoint is written.

        Raises:
          TrainingError: if it could not be written.
        """
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def _write(self, leaves: Leaves, meta: dict[str, Any], told: directory.Row) -> None:
        update, began = meta["update"], time.perf_counter()
        try:
            if self._is_gone():  # Orbax would create the directory again, without a config
                raise FileNotFoundError
            if _is_sound(leaves) and update not in self._manager.all_steps():
                self._write_step(leaves, meta, told)
        except Exception as error:  # on a full disk, Orbax raises errors of many types
            why = self._why(error)
            raise TrainingError(f"checkpoint {update} cannot be written: {why}.") from None
        heap.release()
        self.write_seconds = time.perf_counter() - began

    def _is_gone(self) -> bool:
        """Returns whether the run's directory was removed."""
        return self._binding is not None and not (self._run / directory.CONFIG).exists()

    def _why(self, error: Exception) -> str:
        """Explains why a checkpoint could not be written, even if the run was removed."""
        why = _why(error)
        if not self._is_gone() and why != os.strerror(errno.ENOSPC):
            time.sleep(_REMOVAL)
        return f"{self._run} was removed" if self._is_gone() else why

    def _write_step(self, leaves: Leaves, meta: dict[str, Any], told: directory.Row) -> None:
        import orbax.checkpoint as ocp

        update = meta["update"]
        meta |= {"digest": digest(leaves), "of": None if self._binding is None else self._binding}
        saved = self._manager.save(
            update,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(leaves),
                meta=ocp.args.JsonSave(meta | {"seal": _seal(meta)}),
            ),
        )
        if not saved:
            raise FileExistsError("a newer checkpoint exists")
        step = self._folder / str(update)
        directory.write_json(step / _MANIFEST, _file_digests(step))
        with directory.Log(self._run / directory.SAVED) as log:
            log.write([{"update": update, "digest": meta["digest"], **told}])
        self._prune()

    def _prune(self) -> None:
        """Removes all checkpoints except the newest ones and the best."""
        steps = sorted(self._manager.all_steps())
        rows = directory.read_rows(self._run / directory.SAVED, None, whole=False)
        scores = {
            row.get("update"): row["score"]
            for row in rows
            if isinstance(row.get("score"), int | float)
        }
        rated = [step for step in steps if step in scores]
        best = max(rated, key=lambda step: (scores[step], step), default=None)
        for step in steps[: -self._keep]:
            if step != best:
                self._manager.delete(step)

    def __enter__(self) -> "Checkpoints":
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Waits until everything is written."""
        try:
            self.wait()
        finally:
            self._thread.shutdown()
            if "_manager" in self.__dict__:
                self._manager.close()


def _options() -> "ocp.CheckpointManagerOptions":
    """Makes the options with which Orbax reads and writes without waiting for other processes."""
    import orbax.checkpoint as ocp

    found = ocp.CheckpointManagerOptions(create=False, enable_async_checkpointing=False)
    if hosts.count() > 1:
        own = jax.process_index()
        found.multiprocessing_options = ocp.options.MultiprocessingOptions(
            primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
        )
    return found


def _put_aside(step: Path) -> None:
    """Moves a step to `passed_over`, and replaces an older step of the same name there."""
    aside = step.parents[1] / "passed_over" / step.name
    shutil.rmtree(aside, ignore_errors=True)
    aside.parent.mkdir(exist_ok=True)
    step.rename(aside)


def _why(error: Exception) -> str:
    """Extracts the reason of a failed write.

    TensorStore gives the reason at the very end of its text.
    """
    full = os.strerror(errno.ENOSPC)
    if full in str(error):
        return full
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


@functools.cache
def _quieten() -> None:
    """Silences Orbax's progress messages, and the errors that it logs beside our own message.

    When a file cannot be written, Orbax closes its event loop, but TensorStore still reports the
    other files to it.
    """
    absl_logging.set_verbosity(absl_logging.FATAL)
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    tell = sys.unraisablehook

    def leave_out(unraisable: "sys.UnraisableHookArgs") -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            tell(unraisable)

    sys.unraisablehook = leave_out


def _is_sound(leaves: Leaves) -> bool:
    """Returns whether all learned values are finite, so that a run can go back to this state."""
    learned = [x for name, x in leaves.items() if name.startswith("learners/")]
    return all(np.isfinite(x).all() for x in learned if np.issubdtype(x.dtype, np.floating))


def _file_digests(step: Path) -> dict[str, str]:
    """Returns the SHA-256 of each file of a step, in hexadecimal, by its relative path."""
    files = sorted(path for path in step.rglob("*") if path.is_file() and path.name != _MANIFEST)
    found = {}
    for path in files:
        with path.open("rb") as file:
            found[str(path.relative_to(step))] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def _check_files(step: Path) -> None:
    """Refuses a step if its files have changed since they were written.

    A step without a list of files passes. Older versions wrote such steps, and so does a run that
    is killed just after Orbax finishes.
    """
    if not (step / _MANIFEST).exists():
        return
    try:
        expected = json.loads((step / _MANIFEST).read_text())
    except (OSError, ValueError, RecursionError):
        expected = None
    if expected != _file_digests(step):
        raise CheckpointError("its files do not match their digests")


def _seal(meta: Mapping[str, Any]) -> str:
    """Returns the SHA-256 of a checkpoint's metadata, in hexadecimal."""
    return hashlib.sha256(json.dumps(meta, sort_keys=True).encode()).hexdigest()


def to_leaves(state: Any) -> Leaves:
    """Flattens a state to named arrays. PRNG keys become their data; empty arrays are dropped."""
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
      leaves: the arrays, as `to_leaves` gave them.
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


def of_seed(leaves: Leaves, lane: int, seeds: int) -> Leaves:
    """Extracts one seed from a run's checkpoint.

    Args:
      leaves: [N, ...] arrays of a run.
      lane: index of the seed, 0..N-1.
      seeds: N, the number of seeds in the config.

    Returns:
      The leaves of that seed, without the leading axis.

    Raises:
      CheckpointError: if the checkpoint has another number of seeds.
    """
    found = leaves["update"].shape
    if found != (seeds,):
        raise CheckpointError(
            f"the checkpoint holds {found[0] if found else 'no axis of'} seeds, but the config "
            f"says {seeds}: it belongs to another run."
        )
    return {name: leaf[lane] for name, leaf in leaves.items()}


def restore(run: Path, update: int | None = None) -> tuple[Leaves, int, list[str]]:
    """Reads a run's newest sound checkpoint, or its checkpoint of `update`, as `find` does.

    Returns:
      The leaves, the update, and a sentence for each skipped checkpoint.
    """
    kept = find(run, update)
    return kept.leaves, kept.update, kept.skipped


def steps(run: Path) -> list[int]:
    """Lists the updates of a run's checkpoints, sound or not, newest first."""
    try:
        found = [path.name for path in (run / FOLDER).iterdir() if path.is_dir()]
    except OSError:
        return []
    return sorted((int(name) for name in found if name.isdecimal()), reverse=True)


def find(run: Path, update: int | None = None) -> Kept:
    """Reads a run's newest sound checkpoint, or its checkpoint of `update`.

    Args:
      run: the run directory.
      update: update of the checkpoint to read; None for the newest.

    Raises:
      CheckpointError: if there is no sound checkpoint.
    """
    import orbax.checkpoint as ocp

    _quieten()
    there = steps(run)
    if not there:
        raise CheckpointError(f"{run} holds no checkpoints: give a run directory that has some.")
    if update is not None and update not in there:
        raise CheckpointError(f"{run} has no checkpoint of update {update}: it has {there}.")
    skipped, bound = [], binding(run)
    with ocp.CheckpointManager((run / FOLDER).resolve(), options=_options()) as manager:
        for step in [update] if update is not None else there:
            try:
                leaves, meta = _read(manager, step, bound)
            except Exception as error:  # Orbax raises errors of many types
                reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
                skipped.append(f"checkpoint {step} of {run} cannot be used ({reason})")
                continue
            told = "seal" in meta
            notes = [] if told else [f"checkpoint {step} of {run} does not record its run"]
            scale = meta.get("rate_scale", 1.0)
            return Kept(leaves, step, meta.get("logs", {}), scale, skipped, notes)
    raise CheckpointError(f"{run} has no sound checkpoint: {'; '.join(skipped)}.")


def _read(
    manager: "ocp.CheckpointManager", step: int, bound: Binding | None
) -> tuple[Leaves, dict[str, Any]]:
    """Reads one step, and checks its digests and that it belongs to this update, config and run."""
    import orbax.checkpoint as ocp

    _check_files(Path(manager.directory) / str(step))
    found = manager.restore(
        step,
        args=ocp.args.Composite(state=ocp.args.StandardRestore(), meta=ocp.args.JsonRestore()),
    )
    leaves = {name: np.asarray(leaf) for name, leaf in found["state"].items()}
    meta = dict(found["meta"])
    seal = meta.pop("seal", None)
    if (seal is None and set(meta) != _OLD_META) or (seal is not None and seal != _seal(meta)):
        raise CheckpointError("its metadata does not match its digest")
    if digest(leaves) != meta["digest"]:
        raise CheckpointError("its contents do not match its digest")
    if meta["update"] != step or np.any(leaves.get("update", step) != step):
        raise CheckpointError(f"it belongs to update {meta['update']}")
    if seal is None:
        return leaves, meta
    _check_binding(meta["of"], bound)
    return leaves, meta | {"seal": seal}


def _check_binding(found: list[Any] | None, bound: Binding | None) -> None:
    """Refuses a checkpoint of another run or config."""
    if bound is None or found is None:
        return
    if found[0] != bound.run:
        raise CheckpointError(f"it belongs to run {found[0]}, but this is run {bound.run}")
    if found[1] != bound.config:
        raise CheckpointError("it was written with another config.json")


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")
