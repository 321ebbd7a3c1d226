"""Implements `init_from=DIR`: a new run starts with another run's networks and normaliser.

Optimiser, learning rate, curriculum, arenas, keys and counters start fresh, with one exception. The
number of robots that have trained is kept, so that a promotion does not copy one learner over
another that has already learned.

If the other run has as many seeds, each seed starts from its counterpart. If the other run has one
seed, all seeds start from that seed.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from swarmjax import extension
from swarmjax.config import ConfigError, show
from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import CheckpointError, Leaves
from swarmjax.run.load_settings import from_stored, read_config
from swarmjax.run.settings import TrainConfig
from swarmjax.task.config import resolve_encoding
from swarmjax.training.loop import TrainState

_CARRIED = ("params", "normalizer")  # parts of a learner
_EXPLORED = "explored"  # another part of a learner whose exploration is scheduled
# How many robots have trained; a promotion does not overwrite these robots' learners.
_MET = "curriculum/met"


@dataclass(frozen=True, kw_only=True)
class Source:
    """The learned state that a new run starts from.

    Attributes:
      run: directory of the source run.
      update: update of its checkpoint.
      leaves: arrays of the learners' networks and normalisers, as `checkpoint.to_leaves` names
        them, with one entry on the leading axis for each seed of the new run.
      skipped: a sentence for each newer checkpoint that is damaged.
    """

    run: Path
    update: int
    leaves: Leaves
    skipped: list[str]


def read(settings: TrainConfig) -> Source | None:
    """Reads the newest sound checkpoint of the run in `init_from`.

    Args:
      settings: the config of the new run.

    Returns:
      The learned state; None without `init_from`.

    Raises:
      ConfigError: if there is no such checkpoint, or its networks differ from those of the config.
    """
    if settings.init_from is None:
        return None
    run, stored = Path(settings.init_from), _read_config(settings.init_from)
    _check_alike(settings.init_from, stored, settings)
    try:
        leaves, update, skipped = checkpoint.restore(run)
    except CheckpointError as error:
        raise _refused(settings.init_from, error) from None
    prefixes = (*(f"learners/{name}/" for name in _CARRIED), f"learners/{_EXPLORED}")
    times = settings.seeds // stored.seeds
    carried = {
        name: np.repeat(leaf, times, axis=0)
        for name, leaf in leaves.items()
        if name.startswith(prefixes) or name == _MET
    }
    return Source(run=run, update=update, leaves=carried, skipped=skipped)


def carry(source: Source, state: TrainState, settings: TrainConfig) -> TrainState:
    """Puts what was learned into the first state of a new run.

    Args:
      source: the learned state, as `read` gave it.
      state: the first state, as `seeds.init` gave it.
      settings: the config of the new run. `init_from_std` selects the exploration to start with.

    Returns:
      The state with the networks and normalisers of the source. The curriculum in this state
      records how many robots have trained them.

    Raises:
      ConfigError: if the checkpoint does not match the config in its directory.
    """
    fresh = {name: getattr(state.learners, name) for name in _CARRIED}
    if settings.init_from_std == "keep" and f"learners/{_EXPLORED}" in source.leaves:
        fresh[_EXPLORED] = state.learners.explored
    template = {"learners": fresh, "curriculum": {"met": state.curriculum.met}}
    try:
        found = checkpoint.from_leaves(source.leaves, template)
    except CheckpointError as error:
        raise _refused(str(source.run), error) from None
    carried = found["learners"]
    if settings.init_from_std == "reset":
        log_std = state.learners.params["actor"]["log_std"]
        actor = carried["params"]["actor"] | {"log_std": log_std}
        carried["params"] = carried["params"] | {"actor": actor}
    met = jnp.maximum(state.curriculum.met, found["curriculum"]["met"])
    curriculum = replace(state.curriculum, met=met)
    return replace(state, learners=replace(state.learners, **carried), curriculum=curriculum)


def _read_config(init_from: str) -> TrainConfig:
    try:
        return from_stored(read_config(Path(init_from)), "stored ")
    except ConfigError as error:
        raise _refused(init_from, error) from None


def _refused(init_from: str, error: Exception) -> ConfigError:
    return ConfigError(
        f"init_from is {show(init_from)}: it takes the directory of a run with a sound checkpoint, "
        f"but {error}"
    )


def _check_alike(init_from: str, stored: TrainConfig, settings: TrainConfig) -> None:
    """Refuses networks of another shape or number, or with another encoding of observations."""
    if stored.seeds not in (1, settings.seeds):
        raise ConfigError(
            f"init_from is {show(init_from)}, a run of {stored.seeds} seeds, but seeds is "
            f"{settings.seeds}: give seeds={stored.seeds}, or a run of one seed."
        )
    pieces, kinds = extension.load(settings.extensions), ["observation", "network"]
    extension.check_needs(stored.pieces, pieces, init_from, kinds)
    policy = f"algo.policy={stored.algo.policy}"
    if stored.algo.policy == "independent":
        policy += f" sim.max_robots={stored.sim.max_robots}"
    hidden, activation = show(stored.algo.hidden_sizes), stored.algo.activation
    output = stored.algo.mean_activation
    seen, needed = (resolve_encoding(each.task, each.realism) for each in (stored, settings))
    for name, held, wanted, remedy in (
        ("number of learners", stored.learners, settings.learners, policy),
        (
            "algo.hidden_sizes",
            hidden,
            show(settings.algo.hidden_sizes),
            f"algo.hidden_sizes={hidden}",
        ),
        *(
            (f"algo.{key}", held, wanted, f"algo.{key}={held}")
            for key in ("memory", "memory_size", "critic")
            for held, wanted in [
                tuple(show(getattr(each.algo, key), quote="") for each in (stored, settings))
            ]
        ),
        ("algo.activation", activation, settings.algo.activation, f"algo.activation={activation}"),
        (
            "algo.mean_activation",
            output,
            settings.algo.mean_activation,
            f"algo.mean_activation={output}",
        ),
        (
            "task.neighbours.count",
            heard := stored.task.neighbours.count,
            settings.task.neighbours.count,
            f"task.neighbours.count={heard}",
        ),
        ("encoding of observations", seen, needed, f"task.encoding={seen}"),
    ):
        if held != wanted:
            raise ConfigError(
                f"init_from is {show(init_from)}, whose {name} is {held}, but here it is {wanted}: "
                f"give {remedy}, or another run."
            )
