"""Implements `init_from=DIR`: a new run starts with another run's networks and normaliser.

Optimiser, learning rate, curriculum, arenas, keys and counters start fresh. There are two
exceptions: a schedule of exploration goes on, and the number of robots that have trained is kept,
so that a promotion does not copy one learner over another that has already learned.

If the other run has as many seeds as the new run, each new seed starts from its counterpart. If the
other run has one seed, all new seeds start from that seed.
"""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from swarmjax import extension
from swarmjax.config import ConfigError, show
from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import CheckpointError, Kept
from swarmjax.run.load_settings import NETWORK_KEYS, from_stored, read_config
from swarmjax.run.settings import TrainConfig
from swarmjax.task.config import resolve_encoding
from swarmjax.training.loop import TrainState

_EXPLORED = "learners/explored"  # only where exploration is scheduled
_MET = "curriculum/met"  # how many robots have trained
_CARRIED = ("learners/params/", "learners/normalizer/", _EXPLORED, _MET)


def read(settings: TrainConfig) -> Kept | None:
    """Reads the newest sound checkpoint of the run in `init_from`.

    Args:
      settings: the config of the new run.

    Returns:
      The checkpoint, reduced to the arrays that are carried over, for each seed of the new run;
      None without `init_from`.

    Raises:
      ConfigError: if there is no such checkpoint, or its networks differ from those of the config.
    """
    if settings.init_from is None:
        return None
    run = Path(settings.init_from)
    try:
        stored = from_stored(read_config(run), "stored ")
    except ConfigError as error:
        raise _refused(settings, error) from None
    _check_alike(settings, stored)
    try:
        kept = checkpoint.find(run)
    except CheckpointError as error:
        raise _refused(settings, error) from None
    carried = {
        name: np.repeat(leaf, settings.seeds // stored.seeds, axis=0)
        for name, leaf in kept.leaves.items()
        if name.startswith(_CARRIED)
    }
    return kept._replace(leaves=carried)


def carry(source: Kept, state: TrainState, settings: TrainConfig) -> TrainState:
    """Puts what the other run has learned into the first state of a new run.

    Args:
      source: what is carried over, as `read` returns it.
      state: the first state, as `mesh.init` returns it.
      settings: the config of the new run.

    Raises:
      ConfigError: if the checkpoint does not match the config in its directory.
    """
    learners, met = state.learners, state.curriculum.met
    fresh = {"params": learners.params, "normalizer": learners.normalizer}
    if _EXPLORED in source.leaves:
        fresh["explored"] = learners.explored
    template = {"learners": fresh, "curriculum": {"met": met}}
    try:
        found = checkpoint.from_leaves(source.leaves, template)
    except CheckpointError as error:
        raise _refused(settings, error) from None
    met = jnp.maximum(met, found["curriculum"]["met"])
    return replace(
        state,
        learners=replace(learners, **found["learners"]),
        curriculum=replace(state.curriculum, met=met),
    )


def _refused(settings: TrainConfig, error: Exception) -> ConfigError:
    return ConfigError(
        f"init_from is {show(settings.init_from)}, which must be the directory of a run with a "
        f"usable checkpoint, but {error}"
    )


def _check_alike(settings: TrainConfig, stored: TrainConfig) -> None:
    """Refuses a run whose networks differ in shape, number or encoding of observations."""
    given = show(settings.init_from)
    if stored.seeds not in (1, settings.seeds):
        raise ConfigError(
            f"init_from is {given}, a run of {stored.seeds} seeds, but seeds is {settings.seeds}: "
            f"give seeds={stored.seeds}, or init_from a run of one seed."
        )
    pieces, kinds = extension.load(settings.extensions), ["observation", "network"]
    extension.check_needs(stored.pieces, pieces, settings.init_from or "", kinds)
    sensors = [len(each.robot.sensor_poses) for each in (stored, settings)]
    if sensors[0] != sensors[1]:
        raise ConfigError(
            f"init_from is {given}, a run whose robot has {sensors[0]} sensors, but the robot of "
            f"this run has {sensors[1]}: give a robot with {sensors[0]} sensors, or another run."
        )
    mine, theirs = _networks(settings), _networks(stored)
    for key, held in theirs.items():
        if held != mine.get(key, held):
            raise ConfigError(
                f"init_from is {given}, a run with {key}={held}, but here {key} is {mine[key]}: "
                f"give {key}={held}, or another run."
            )


def _networks(settings: TrainConfig) -> dict[str, str]:
    """Returns the settings that must be equal in runs with the same networks, by key."""
    algo = settings.algo
    found = {f"algo.{key}": getattr(algo, key) for key in NETWORK_KEYS if key != "network"}
    if algo.policy == "independent":
        found["sim.max_robots"] = settings.sim.max_robots
    found["task.encoding"] = resolve_encoding(settings.task, settings.realism)
    return {key: show(value, quote="") for key, value in found.items()}
