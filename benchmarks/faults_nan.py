"""A campaign of `benchmarks.faults` that puts NaN or infinity into training between calls.

A trial trains a small run, puts NaN or an infinity into one array before a random update, and
continues training. There are three outcomes. `went on`: training continued. `goes back`: the
optimiser took no more steps, so the run returns to its checkpoint. `WRONG`: an update learned a
non-finite number, or the fault changed an arena into which no value was put.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.curriculum.engine import Schedule
from swarmjax.run import trainer
from swarmjax.run.load_settings import load_train
from swarmjax.training import loop, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState

STAGES = ("s1", "s3")
ARENAS, ROLLOUT, UPDATES = 64, 32, 100
LAST = 20  # updates over which success is measured
SEEDS = 4  # number of undisturbed runs per stage; every trial has the seed of one of them
SHARES = (0.01, 0.1, 1.0)  # shares of the arenas, or of an array's numbers, that are spoilt
VALUES = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf}
HUGE = 1e30  # m; the reward stays finite, but its gradient does not
# Arrays that a fault spoils in some arenas; `gradient` makes a reward whose square is infinite.
IN_ARENAS = ("qpos", "qvel", "observation", "distance", "return", "gradient")
IN_LEARNERS = ("params", "optimizer_state")
KINDS = (*IN_ARENAS, *IN_LEARNERS)


class Stand(NamedTuple):
    """A program, compiled once for all trials of a process.

    Attributes:
      train: (state, n) -> (state, metrics) of n updates; the given state does not change.
      start: seed -> the first state.
    """

    train: Callable[[TrainState, int], tuple[TrainState, dict[str, np.ndarray]]]
    start: Callable[[int], TrainState]


@functools.cache
def stand(stage: str) -> Stand:
    """Compiles the training of a stage."""
    words = [f"stage={stage}", f"arenas={ARENAS}", f"algo.rollout_length={ROLLOUT}"]
    budget = f"budget={ARENAS * ROLLOUT * UPDATES}"
    config = load_train([*words, budget, "algo.hidden_sizes=[16]", "sim.impl=jax"])
    program, schedule = programs.load(config)
    call = jax.jit(partial(seeds.train_chunk, program))
    begin = jax.jit(partial(loop.init, program))

    def start(seed: int) -> TrainState:
        return jax.tree.map(lambda x: x[None], begin(schedule, np.int32(seed)))

    return Stand(partial(_train, call, schedule), start)


def _train(
    call: Callable[..., Any], schedule: Schedule, state: TrainState, n: int
) -> tuple[TrainState, dict[str, np.ndarray]]:
    """Trains for n updates; returns the state and metrics [n]."""
    state, metrics = call(schedule, state, np.int32(n))
    return state, {name: np.asarray(x)[0, :n] for name, x in metrics.items()}


@functools.cache
def undisturbed(stage: str, seed: int) -> float:
    """Returns the share of targets reached at the end of an undisturbed run."""
    there = stand(stage)
    return success(there.train(there.start(seed), UPDATES)[1])


def success(metrics: dict[str, np.ndarray]) -> float:
    """Returns the share of targets reached over the last `LAST` updates."""
    return float(metrics["reached"][-LAST:].sum() / metrics["targets"][-LAST:].sum())


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Puts one fault into a run, and judges how the training continues.

    Args:
      seed: Seed of the trial.
      folder: Folder of the trial; nothing is written.

    Returns:
      The entries of the line: the fault, the outcome, and the share of targets at the end.
    """
    del folder
    random = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    share = SHARES[seed // len(KINDS) % len(SHARES)]
    stage, value = str(random.choice(STAGES)), str(random.choice([*VALUES]))
    own, update = int(random.integers(SEEDS)), int(random.integers(1, UPDATES - LAST))
    there = stand(stage)
    before, _ = there.train(there.start(own), update)
    touched = np.zeros(ARENAS, bool)
    touched[random.permutation(ARENAS)[: max(1, round(share * ARENAS))]] = True
    number = HUGE if kind == "gradient" else VALUES[value]
    if kind in IN_ARENAS:
        spoilt = spoil_arenas(before, kind, number, touched)
    else:
        spoilt = spoil_learner(before, kind, number, share, random)
    after, first = there.train(spoilt, 1)
    twin, _ = there.train(before, 1)
    last, rest = there.train(after, UPDATES - update - 1)
    alike = kind in IN_LEARNERS or are_equal(after.arenas, twin.arenas, ~touched)
    metrics = {name: np.concatenate([first[name], rest[name]]) for name in first}
    known = {"kind": kind, "value": "huge" if kind == "gradient" else value, "share": share}
    return {
        "outcome": judge(spoilt, last, metrics, alike=alike),
        **known,
        "stage": stage,
        "update": update,
        "broken_arenas": int(metrics["broken_arenas"].sum()),
        "skipped_steps": int(metrics["skipped_steps"].sum()),
        "neighbours_alike": alike if kind in IN_ARENAS else None,
        "success": success(metrics),
        "undisturbed": undisturbed(stage, own),
    }


def spoil_arenas(state: TrainState, kind: str, value: float, touched: np.ndarray) -> TrainState:
    """Puts a value into the first number of an array in each touched arena [A]."""
    arenas = state.arenas

    def put(x: jax.Array, column: int = 0) -> jax.Array:
        flat = x.reshape(*x.shape[:2], -1)
        spoilt = jnp.where(touched, value, flat[0, :, column])
        return flat.at[0, :, column].set(spoilt).reshape(x.shape)

    if kind in ("qpos", "qvel"):
        arenas = replace(arenas, sim=arenas.sim._replace(**{kind: put(getattr(arenas.sim, kind))}))
    elif kind == "return":
        total = put(arenas.episode.reward)
        arenas = replace(arenas, episode=arenas.episode._replace(reward=total))
    else:
        name = "distance" if kind == "gradient" else kind
        arenas = replace(arenas, **{name: put(getattr(arenas, name))})
    return replace(state, arenas=arenas)


def spoil_learner(
    state: TrainState, kind: str, value: float, share: float, random: np.random.Generator
) -> TrainState:
    """Puts a value into a share of the numbers in one array of the learner."""
    leaves, structure = jax.tree.flatten(getattr(state.learners, kind))
    arrays = [i for i, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    index = int(random.choice(arrays))
    flat = np.array(leaves[index]).ravel()
    flat[random.permutation(flat.size)[: max(1, round(share * flat.size))]] = value
    leaves[index] = jnp.asarray(flat.reshape(leaves[index].shape))
    spoilt = jax.tree.unflatten(structure, leaves)
    return replace(state, learners=replace(state.learners, **{kind: spoilt}))


def are_equal(one: Any, other: Any, where: np.ndarray) -> bool:
    """Tells whether two states are bitwise equal in some arenas [A]."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(np.asarray(a)[0, where], np.asarray(b)[0, where]) for a, b in pairs)


def judge(
    spoilt: TrainState, last: TrainState, metrics: dict[str, np.ndarray], *, alike: bool
) -> str:
    """Determines the outcome of a trial.

    Args:
      spoilt: The state with the fault.
      last: The state at the end of the run.
      metrics: [U] metrics of all updates since the fault.
      alike: Whether the untouched arenas are equal to the same arenas of an undisturbed run.
    """
    if not alike:
        return "WRONG"
    # A run returns to its checkpoint after `PATIENCE` updates without learning (`trainer`).
    barren = np.isnan(metrics["policy_loss"]) | (metrics["broken_arenas"] >= ARENAS * ROLLOUT)
    if barren[-trainer.PATIENCE :].all():
        held, kept = spoilt.learners.params, last.learners.params
        same = jax.tree.map(partial(np.array_equal, equal_nan=True), held, kept)
        return "goes back" if all(jax.tree.leaves(same)) else "WRONG"
    learned = (last.learners.params, last.learners.normalizer)
    numbers = [leaf for leaf in jax.tree.leaves(learned) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    told = [metrics[name][-LAST:] for name in ("policy_loss", "value_loss", "grad_norm")]
    return "went on" if all(np.isfinite(x).all() for x in [*numbers, *told]) else "WRONG"
