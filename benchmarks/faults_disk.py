"""Campaigns of `benchmarks.faults` that disturb a run from outside, or its numbers from inside.

`disk`: in the first `SIZES` trials a run gets a small disk. The disk's size grows from trial to
trial, up to a size that just holds the run. The other trials alternate between four faults: a disk
that becomes read-only, a directory that is removed, two processes on one directory, and a clock
that is set back. Afterwards the run is started once more without a fault, and must end like an
undisturbed run. Disks are mounted in a separate mount namespace (`unshare`, util-linux).
`libfaketime` sets the clock. If either is missing, the outcome of the trial is `not tried`.

`nan`: a trial trains a small run, puts NaN or an infinity into one array before a random update,
and continues training. There are three outcomes. `went on`: training continued. `stops`: the
optimiser took no more steps, so the run ends. `WRONG`: an update learned a
non-finite number, or the fault changed an arena into which no value was put.
"""

import contextlib
import functools
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.faults_runs import is_whole, start, train_command, undisturbed
from swarmjax.curriculum.engine import Schedule
from swarmjax.run import directory
from swarmjax.run.load_settings import load_train
from swarmjax.run.run import PATIENCE
from swarmjax.training import loop, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState

SIZES = 20
PAGE = 4096  # bytes; a tmpfs stores files in whole pages
MOST_SECONDS = 120.0  # a run that takes longer counts as hanging
_LIBRARY = "/usr/lib/*/faketime/libfaketime.so.1"  # Debian's package `libfaketime`
STAGES = ("s1", "s3")
ARENAS, ROLLOUT, UPDATES = 64, 32, 100
LAST = 20  # updates over which success is measured
SEEDS = 4  # number of undisturbed runs per stage; every trial has the seed of one of them
SHARES = (0.01, 0.1, 1.0)  # shares of the arenas, or of an array's numbers, that are spoilt
VALUES = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf}
HUGE = 1e30  # m; the reward stays finite, but its gradient does not
# Arrays that a fault spoils in some arenas. `gradient` sets a reward whose square is infinite.
IN_ARENAS = ("qpos", "qvel", "observation", "distance", "return", "gradient")
IN_LEARNERS = ("params", "optimizer_state")
KINDS = (*IN_ARENAS, *IN_LEARNERS)


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Disturbs a run, then resumes it without a fault until it ends.

    Args:
      seed: Seed of the trial; the seed's last six digits choose the fault.
      folder: Empty folder of the trial.

    Returns:
      The kind of fault, how the run ended, and the outcome.
    """
    undisturbed()  # called first, since the uncached call takes as long as a run
    number, random = seed % 1_000_000, np.random.default_rng(seed)
    if number < SIZES:
        return _judge_disk("full disk", _full(number, folder), folder / "run")
    kind = [*_KINDS][number % len(_KINDS)]
    return _judge_disk(kind, _KINDS[kind](random, folder), folder / "run")


def _judge_disk(kind: str, told: dict[str, Any], run: Path) -> dict[str, Any]:
    """Resumes the run until it ends, and checks whether it lost anything."""
    if "missing" in told:
        return {"outcome": "not tried", "kind": kind, **told}
    process = start(run)
    said, _ = process.communicate()
    whole = is_whole(run)
    sound = told["answered"] and process.returncode == 0 and all(whole.values())
    last = {} if sound else {"said_at_last": said[-500:]}
    return {"outcome": "ok" if sound else "WRONG", "kind": kind, **told, **whole, **last}


def _hindered(words: list[str], allowed: set[int], **given: Any) -> dict[str, Any]:
    """Runs a command that may fail, but only with an allowed exit code and without a traceback.

    Args:
      words: The command.
      allowed: Allowed exit codes.
      given: Arguments for `subprocess.run`.
    """
    began = time.perf_counter()
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, timeout=MOST_SECONDS, check=False, **given
        )
    except subprocess.TimeoutExpired:
        return {"answered": False, "code": None, "said": "hangs", "seconds": MOST_SECONDS}
    said = (done.stdout + done.stderr).strip()
    sentence = said.splitlines()[-1] if said else ""
    answered = done.returncode in allowed and "Traceback" not in said
    return {
        "answered": answered,
        "code": done.returncode,
        "said": sentence if answered else said[-500:],
        "seconds": round(time.perf_counter() - began, 1),
    }


@functools.cache
def _needed() -> int:
    """Returns the disk space that an undisturbed run needs at its end, bytes."""
    with tempfile.TemporaryDirectory() as folder:
        start(Path(folder) / "run").communicate()
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        return sum(-(-path.stat().st_size // PAGE) * PAGE for path in files)


def _on_a_disk(folder: Path, size: int, options: str, run: Path | None = None) -> dict[str, Any]:
    """Trains on a separate disk, and copies the run back to `folder`/run.

    Args:
      folder: Folder of the trial.
      size: Size of the disk, bytes.
      options: Mount options, set after `run` has been copied to the disk.
      run: A run to copy to the disk first; None for a new run.
    """
    if shutil.which("unshare") is None:
        return {"missing": "unshare"}
    disk, kept = folder / "disk", folder / "run"
    disk.mkdir()
    before = "" if run is None else f"cp -r {run} {disk}/run;"
    command = " ".join(train_command(disk / "run"))
    script = (
        f"mount -t tmpfs -o size={size} tmpfs {disk} || exit 99; {before}"
        f"mount -o remount,{options} {disk}; {command}; code=$?;"
        f"rm -rf {kept}; [ -d {disk}/run ] && cp -r {disk}/run {kept}; exit $code"
    )
    told = _hindered(["unshare", "--mount", "--map-root-user", "sh", "-c", script], {0, 1, 2})
    return {"missing": "leave to mount a disk"} if told["code"] == 99 else told


def _full(number: int, folder: Path) -> dict[str, Any]:
    """Trains on a disk that is too small."""
    size = max(1, round(_needed() * (number + 1) / SIZES / PAGE)) * PAGE
    return _on_a_disk(folder, size, "rw") | {"size": size, "needed": _needed()}


def _read_only(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Resumes a run on a disk that has become read-only."""
    run = folder / "run"
    _begin(run, random)
    return _on_a_disk(folder, 8 * _needed(), "ro", run if run.exists() else None)


def _begin(run: Path, random: np.random.Generator) -> None:
    """Trains for a while, then asks the run to stop."""
    process = start(run)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(random.uniform(0.3, 1.0) * undisturbed().ends_s)
    process.terminate()
    process.communicate()


def _removed(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Removes the directory of a run while the run trains."""
    run = folder / "run"
    wait = random.uniform(0.0, 0.3) * undisturbed().ends_s
    log = run / directory.METRICS
    remove = f"while ! [ -e {log} ]; do sleep 0.05; done; sleep {wait:.3f}; rm -rf {run}"
    gone = subprocess.Popen(["sh", "-c", remove])
    told = _hindered(train_command(run), {0, 1})
    gone.wait()
    shutil.rmtree(run, ignore_errors=True)  # files that were written after the removal
    return told


def _two(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Starts a second process on the directory of a run."""
    run = folder / "run"
    first = start(run)
    time.sleep(random.uniform(0.0, 0.8) * undisturbed().ends_s)
    told = _hindered(train_command(run), {0, 2})
    first.communicate()
    # One process trains and the other is refused. If the second process starts late, it finds a
    # finished run.
    codes = {first.returncode, told["code"]}
    return told | {"answered": told["answered"] and 0 in codes and codes <= {0, 2}}


def _clock(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Resumes a run with the clock set back by one day."""
    library = next(iter(Path("/").glob(_LIBRARY[1:])), None)
    if library is None:
        return {"missing": "libfaketime"}
    run = folder / "run"
    _begin(run, random)
    clock = {"LD_PRELOAD": str(library), "FAKETIME": "-1d", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    return _hindered(train_command(run), {0}, env=os.environ | clock)


_KINDS: Mapping[str, Callable[[np.random.Generator, Path], dict[str, Any]]] = {
    "read-only disk": _read_only,
    "removed directory": _removed,
    "two processes": _two,
    "clock set back": _clock,
}


# Numbers


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
    call = jax.jit(seeds.chunk(program))
    begin = jax.jit(partial(loop.init, program))

    def begin_seed(seed: int) -> TrainState:
        return jax.tree.map(lambda x: x[None], begin(schedule, np.int32(seed)))

    return Stand(partial(_train, call, schedule), begin_seed)


def _train(
    call: Callable[..., Any], schedule: Schedule, state: TrainState, n: int
) -> tuple[TrainState, dict[str, np.ndarray]]:
    """Trains for n updates; returns the state and metrics [n]."""
    state, metrics = call(schedule, state, np.int32(n))
    return state, {name: np.asarray(x)[0, :n] for name, x in metrics.items()}


@functools.cache
def undisturbed_success(stage: str, seed: int) -> float:
    """Returns the share of targets reached at the end of an undisturbed run."""
    there = stand(stage)
    return success(there.train(there.start(seed), UPDATES)[1])


def success(metrics: dict[str, np.ndarray]) -> float:
    """Returns the share of targets reached over the last `LAST` updates."""
    return float(metrics["reached"][-LAST:].sum() / metrics["targets"][-LAST:].sum())


def spoil(seed: int, folder: Path) -> dict[str, Any]:
    """Puts one fault into a run, and records how the training continues.

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
        "undisturbed": undisturbed_success(stage, own),
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
    # A run ends after `PATIENCE` updates without learning.
    barren = np.isnan(metrics["policy_loss"]) | (metrics["broken_arenas"] >= ARENAS * ROLLOUT)
    if barren[-PATIENCE:].all():
        held, kept = spoilt.learners.params, last.learners.params
        same = jax.tree.map(partial(np.array_equal, equal_nan=True), held, kept)
        return "stops" if all(jax.tree.leaves(same)) else "WRONG"
    learned = (last.learners.params, last.learners.normalizer)
    numbers = [leaf for leaf in jax.tree.leaves(learned) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    told = [metrics[name][-LAST:] for name in ("policy_loss", "value_loss", "grad_norm")]
    return "went on" if all(np.isfinite(x).all() for x in [*numbers, *told]) else "WRONG"
