"""Checkpoints: everything that changes in a run, and a digest of it. Resuming is exact.

Orbax writes the steps; what it lacks is added here: a digest that notices damage (one flipped bit
restores silently otherwise), a binding to update, config and run that notices a swapped, renamed or
foreign step, and going back to the newest step that is sound.
A checkpoint is a flat dictionary from names such as `learners/params/actor/mean/kernel` to
arrays, so that it can be read without the program that wrote it. Those of a run have a leading
axis of seeds.
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
from swarmjax.run import directory, heap, hosts, practised
from swarmjax.run.errors import CheckpointError, TrainingError

# Orbax takes half a second to import, which a run spends while it compiles (`trainer`).
if TYPE_CHECKING:
    import orbax.checkpoint as ocp

Leaves = dict[str, np.ndarray]

FOLDER = hosts.CHECKPOINTS
ARENAS = "arenas/"  # of the names of leaves
_OLD_META = {"digest", "update"}  # all that checkpoints held before they were bound to their run
# In each step: the SHA-256 of its files. Given damaged files Orbax fails too, but it prints the
# tracebacks of its threads as well.
_MANIFEST = "files.json"
_REMOVAL = 0.5  # s, which removing a directory may take from its checkpoints to its config
_UNFINISHED = "*.orbax-checkpoint-tmp*"  # what Orbax renames when it is whole


class Binding(NamedTuple):
    """What a checkpoint is of.

    Attributes:
      run: Id of the run; None before runs had one.
      config: Digest of what the run's config fixes.
    """

    run: str | None
    config: str


class Kept(NamedTuple):
    """A sound checkpoint.

    Attributes:
      leaves: As `to_leaves` gave them.
      update: Updates that were done.
      logs: Bytes of each log that belong to it, by name; empty in older checkpoints.
      rate_scale: What the learning rates were multiplied by.
      skipped: A sentence for each newer checkpoint that is damaged.
      notes: Sentences about what is not known of this one.
    """

    leaves: Leaves
    update: int
    logs: dict[str, int]
    rate_scale: float
    skipped: list[str]
    notes: list[str]

    @property
    def has_arenas(self) -> bool:
        """Whether the state is whole; without arenas a run draws others when it goes on."""
        return any(name.startswith(ARENAS) for name in self.leaves)


def binding(run: Path) -> Binding | None:
    """Reads what the checkpoints of a run directory must be of; None without a config."""
    try:
        stored = json.loads((run / directory.CONFIG).read_text())
        return Binding(stored.get("run", {}).get("id"), directory.config_digest(stored))
    except (OSError, ValueError, AttributeError, RecursionError):
        return None


class Checkpoints:
    """The checkpoints of one run directory, for writing. Close it, or use `with`.

    A thread writes them while the run goes on. The newest are kept, and the one with the highest
    score.

    Attributes:
      write_seconds: That the newest one took to write.
    """

    def __init__(self, run: Path, keep: int, update: int | None = None) -> None:
        """Opens `run`/checkpoints, keeping the `keep` newest.

        With `update`, where the run goes on, checkpoints after it are put aside: they were passed
        over as damaged, and Orbax would save nothing before them. Otherwise nothing is done until
        the first is saved, so that a run need not wait for Orbax before it begins.
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
        """Begins to write a state, unless its update is there or what it learned is not finite.

        Args:
          state: What changes in the run; it is copied before this returns.
          update: Updates that are done.
          logs: Bytes of each log that belong to it, by name.
          score: How good it is; None if that is not known.
          rate_scale: What the learning rates were multiplied by.
          of: What else its line in the list of checkpoints says.

        Raises:
          TrainingError: If the checkpoint before could not be written.
        """
        state = hosts.gather(state)
        if not hosts.is_first():
            return
        self.wait()
        meta = {"update": update, "logs": dict(logs or {}), "rate_scale": rate_scale}
        told = {"score": score, "rate_scale": rate_scale, **(of or {})}
        # The next call of the program writes over the state, which NumPy may share on a CPU.
        leaves = {name: np.array(leaf) for name, leaf in to_leaves(state).items()}
        self._pending = self._thread.submit(self._write, leaves, meta, told)

    def wait(self) -> None:
        """Waits until what was begun is written.

        Raises:
          TrainingError: If it could not be written.
        """
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def _write(self, leaves: Leaves, meta: dict[str, Any], told: directory.Row) -> None:
        update, began = meta["update"], time.perf_counter()
        try:
            if self._is_gone():  # Orbax would make another directory, without a config
                raise FileNotFoundError
            if _is_sound(leaves) and update not in self._manager.all_steps():
                self._write_step(leaves, meta, told)
        except Exception as error:  # of any type that Orbax raises on a full disk
            why = self._why(error)
            raise TrainingError(f"checkpoint {update} cannot be written: {why}.") from None
        heap.release()
        self.write_seconds = time.perf_counter() - began

    def _is_gone(self) -> bool:
        """Tells whether somebody removed the directory of the run."""
        return self._binding is not None and not (self._run / directory.CONFIG).exists()

    def _why(self, error: Exception) -> str:
        """Says why a checkpoint could not be written."""
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
            raise FileExistsError("a newer one is there")
        step = self._folder / str(update)
        directory.write_json(step / _MANIFEST, _file_digests(step))
        best = practised.best(leaves)
        if best is not None:
            directory.write_json(self._run / practised.FILE, best)
        with directory.Log(self._run / directory.SAVED) as log:
            log.write([{"update": update, "digest": meta["digest"], **told}])
        self._prune()

    def _prune(self) -> None:
        """Removes all but the newest and the best."""
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
    """Lets a process read and write by itself, without waiting for the others of its run."""
    import orbax.checkpoint as ocp

    found = ocp.CheckpointManagerOptions(create=False, enable_async_checkpointing=False)
    if hosts.count() > 1:
        own = jax.process_index()
        found.multiprocessing_options = ocp.options.MultiprocessingOptions(
            primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
        )
    return found


def _put_aside(step: Path) -> None:
    """Moves a step out of the folder of checkpoints, in place of one that was moved before."""
    aside = step.parents[1] / "passed_over" / step.name
    shutil.rmtree(aside, ignore_errors=True)
    aside.parent.mkdir(exist_ok=True)
    step.rename(aside)


def _why(error: Exception) -> str:
    """Says why a checkpoint could not be written; TensorStore names the reason at the very end."""
    full = os.strerror(errno.ENOSPC)
    if full in str(error):
        return full
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


@functools.cache
def _quieten() -> None:
    """Keeps Orbax from telling every step of its own, and its errors beside our sentence.

    When a file cannot be written, Orbax closes its event loop, and TensorStore goes on to tell it
    about the other files.
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
    """Tells whether what was learned is finite: a run must be able to go back to it."""
    learned = [x for name, x in leaves.items() if name.startswith("learners/")]
    return all(np.isfinite(x).all() for x in learned if np.issubdtype(x.dtype, np.floating))


def _file_digests(step: Path) -> dict[str, str]:
    """Returns the SHA-256 of each file of a step, in hexadecimal, by its path within."""
    files = sorted(path for path in step.rglob("*") if path.is_file() and path.name != _MANIFEST)
    found = {}
    for path in files:
        with path.open("rb") as file:
            found[str(path.relative_to(step))] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def _check_files(step: Path) -> None:
    """Refuses a step whose files are not those that were written.

    A run that is killed just after Orbax ended leaves a step that does not list its files, as
    older versions did.
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
    """Returns the SHA-256 of what a checkpoint holds besides arrays, in hexadecimal."""
    return hashlib.sha256(json.dumps(meta, sort_keys=True).encode()).hexdigest()


def to_leaves(state: Any) -> Leaves:
    """Flattens a state to names and arrays; keys become their data, empty arrays are left out."""
    leaves = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        if leaf.size:
            leaves[_name(path)] = np.asarray(leaf)
    return leaves


def from_leaves(leaves: Leaves, template: Any) -> Any:
    """Fills a state of the template's structure.

    Args:
      leaves: as `to_leaves` gave them.
      template: a state, or what `jax.eval_shape` gives of one.

    Returns:
      The state.

    Raises:
      CheckpointError: if a leaf is missing or of another shape or type: another run's.
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
    """Takes one seed out of a run's checkpoint.

    Args:
      leaves: of a run, [N, ...] each.
      lane: of the seed, 0..N-1.
      seeds: N, as the config says.

    Returns:
      The leaves of that seed, without the axis.

    Raises:
      CheckpointError: if the checkpoint has not that many seeds.
    """
    found = leaves["update"].shape
    if found != (seeds,):
        raise CheckpointError(
            f"the checkpoint holds {found[0] if found else 'no axis of'} seeds, but the config "
            f"says {seeds}: it is of another run."
        )
    return {name: leaf[lane] for name, leaf in leaves.items()}


def restore(run: Path, update: int | None = None) -> tuple[Leaves, int, list[str]]:
    """Reads the newest sound checkpoint of a run, or the one of `update`, as `find` does.

    Returns:
      The leaves, the update, and the sentences about what was skipped.
    """
    kept = find(run, update)
    return kept.leaves, kept.update, kept.skipped


def steps(run: Path) -> list[int]:
    """Lists the updates that a run directory has checkpoints of, sound or not, newest first."""
    try:
        found = [path.name for path in (run / FOLDER).iterdir() if path.is_dir()]
    except OSError:
        return []
    return sorted((int(name) for name in found if name.isdecimal()), reverse=True)


def find(run: Path, update: int | None = None) -> Kept:
    """Reads the newest sound checkpoint of a run, or the one of `update`.

    Args:
      run: The run directory.
      update: Which; None for the newest.

    Raises:
      CheckpointError: If there is none that is sound.
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
            except Exception as error:  # of any type that Orbax raises
                reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
                skipped.append(f"checkpoint {step} of {run} cannot be used ({reason})")
                continue
            told = "seal" in meta
            notes = [] if told else [f"checkpoint {step} of {run} does not say which run it is of"]
            scale = meta.get("rate_scale", 1.0)
            return Kept(leaves, step, meta.get("logs", {}), scale, skipped, notes)
    raise CheckpointError(f"{run} has no sound checkpoint: {'; '.join(skipped)}.")


def _read(
    manager: "ocp.CheckpointManager", step: int, bound: Binding | None
) -> tuple[Leaves, dict[str, Any]]:
    """Reads one step and checks its digest, and that it is of this update, config and run."""
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
        raise CheckpointError("what it says of itself does not match its digest")
    if digest(leaves) != meta["digest"]:
        raise CheckpointError("its contents do not match its digest")
    if meta["update"] != step or np.any(leaves.get("update", step) != step):
        raise CheckpointError(f"it is of update {meta['update']}")
    if seal is None:
        return leaves, meta
    _check_binding(meta["of"], bound)
    return leaves, meta | {"seal": seal}


def _check_binding(found: list[Any] | None, bound: Binding | None) -> None:
    """Refuses a checkpoint of another run or of another config."""
    if bound is None or found is None:
        return
    if found[0] != bound.run:
        raise CheckpointError(f"it is of run {found[0]}, and this is run {bound.run}")
    if found[1] != bound.config:
        raise CheckpointError("it was written with another config.json")


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")
