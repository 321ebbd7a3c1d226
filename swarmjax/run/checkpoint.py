"""Checkpoints: everything that changes in a run, and a digest of it. Resuming is exact.

Orbax writes and keeps the steps; what it lacks is added here: a digest that notices damage (one
flipped bit restores silently otherwise), and going back to the newest step that is sound.
A checkpoint is a flat dictionary from names such as `learners/params/actor/mean/kernel` to
arrays, so that it can be read without the program that wrote it. Those of a run have a leading
axis of seeds.
"""

import functools
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import logging as absl_logging

from swarmjax.policy import digest
from swarmjax.run.errors import CheckpointError

# Orbax takes half a second to import, which a run spends while it compiles (`trainer`).
if TYPE_CHECKING:
    import orbax.checkpoint as ocp

Leaves = dict[str, np.ndarray]


class Checkpoints:
    """The checkpoints of one run directory, for writing. Close it, or use `with`."""

    def __init__(self, run: Path, keep: int, update: int | None = None) -> None:
        """Opens `run`/checkpoints, keeping the `keep` newest.

        With `update`, where the run goes on, checkpoints after it are removed: they were passed
        over as damaged, and Orbax would save nothing before them. Otherwise nothing is done until
        the first is saved, so that a run need not wait for Orbax before it begins.
        """
        self._folder, self._keep = (run / "checkpoints").resolve(), keep
        if update is not None:
            for step in self._manager.all_steps():
                if step > update:
                    self._manager.delete(step)

    @functools.cached_property
    def _manager(self) -> "ocp.CheckpointManager":
        import orbax.checkpoint as ocp

        absl_logging.set_verbosity(absl_logging.ERROR)  # Orbax tells every step of its own
        logging.getLogger("absl").setLevel(logging.ERROR)
        options = ocp.CheckpointManagerOptions(max_to_keep=self._keep, create=True)
        return ocp.CheckpointManager(self._folder, options=options)

    def save(self, state: Any, update: int) -> None:
        """Writes a state; an update that is there already is left as it is."""
        import orbax.checkpoint as ocp

        if update in self._manager.all_steps():
            return
        leaves = to_leaves(state)
        self._manager.save(
            update,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(leaves),
                meta=ocp.args.JsonSave({"digest": digest(leaves), "update": update}),
            ),
        )

    def __enter__(self) -> "Checkpoints":
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Waits until everything is written."""
        if "_manager" in self.__dict__:
            self._manager.close()


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
    """Reads the newest sound checkpoint of a run, or the one of `update`.

    Args:
      run: the run directory.
      update: which; None for the newest.

    Returns:
      The leaves, the update, and a sentence for each newer checkpoint that was skipped.

    Raises:
      CheckpointError: if there is none that is sound.
    """
    import orbax.checkpoint as ocp

    folder = (run / "checkpoints").resolve()
    if not folder.is_dir():
        raise CheckpointError(f"{run} holds no checkpoints: give a run directory that has some.")
    with ocp.CheckpointManager(folder) as manager:
        steps = sorted(manager.all_steps(), reverse=True)
        if update is not None and update not in steps:
            raise CheckpointError(f"{run} has no checkpoint of update {update}: it has {steps}.")
        skipped = []
        for step in [update] if update is not None else steps:
            try:
                return _read(manager, step), step, skipped
            except Exception as error:
                reason = str(error).splitlines()[0][:120]
                skipped.append(f"checkpoint {step} of {run} is damaged ({reason})")
    found = "; ".join(skipped) or "there is none"
    raise CheckpointError(f"{run} has no sound checkpoint: {found}.")


def _read(manager: "ocp.CheckpointManager", step: int) -> Leaves:
    """Reads one step and checks its digest."""
    import orbax.checkpoint as ocp

    found = manager.restore(
        step,
        args=ocp.args.Composite(state=ocp.args.StandardRestore(), meta=ocp.args.JsonRestore()),
    )
    leaves = {name: np.asarray(leaf) for name, leaf in found["state"].items()}
    if digest(leaves) != found["meta"]["digest"]:
        raise CheckpointError("its contents do not match its digest")
    return leaves


def _name(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")
