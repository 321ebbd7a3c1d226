"""The host side of a run: calls the compiled chunk, records, shows, saves, and stops when asked."""

import contextlib
import importlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from swarmjax import provenance, words
from swarmjax.curriculum.engine import Schedule
from swarmjax.curriculum.log import log
from swarmjax.run import hosts, memory, recorder
from swarmjax.run.checkpoint import Checkpoints, Kept
from swarmjax.run.directory import EPISODES, METRICS, Row
from swarmjax.run.display import Display, summarize
from swarmjax.run.errors import CheckpointError, DivergedError
from swarmjax.run.recorder import Recorder
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop
from swarmjax.run.weights_and_biases import WandbRuns
from swarmjax.sim import physics
from swarmjax.sim.config import physics_substeps
from swarmjax.training import episodes, loop, mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.program import Program

Built = Program[TrainConfig]  # the program of a run

CALL_SECONDS = 1.0  # what a call should take when run.chunk is auto: the display's pace
ALL_SECONDS = 10.0  # what a call may take when run.chunk is all: so long a signal waits
FIRST_UPDATES = 32  # of the first call then, by which the others are measured
PATIENCE = 10  # updates in a row that taught nothing, after which a run has diverged
GROWTH = 4  # a call is at most this many times as long as the one before


@dataclass(frozen=True)
class Compiled:
    """The compiled chunk and what compiling it took.

    Attributes:
      call: (schedule, state [N], n) -> (state [N], metrics [N, rows]); the state is donated.
      seconds: that tracing and compiling took.
      state_bytes: of device memory for what changes in the run.
      work_bytes: that the program needs besides.
    """

    call: Callable[[Schedule, TrainState, np.int32], tuple[TrainState, dict]]
    seconds: float
    state_bytes: int
    work_bytes: int

    @property
    def total_bytes(self) -> int:
        """Device memory that training needs."""
        return self.state_bytes + self.work_bytes


@dataclass
class Tally:
    """What the host adds up over the whole run, in integers that do not wrap.

    Attributes:
      update: updates of every seed that are done.
      first: updates that were done when this process began.
      compile_s: spent compiling.
      transitions: robot steps that each seed was trained on.
      targets_reached: newest measured share of each stage's targets, by seed.
      earlier_s: spent training before this process began.
      seconds: spent training by this process, compilation apart.
      decisions: promotions and demotions.
      barren: newest updates in a row, by seed, that taught nothing: every gradient step was skipped
        or every arena broke at every step.
    """

    update: int
    first: int
    compile_s: float
    transitions: dict[int, int]
    targets_reached: dict[int, dict[str, float]]
    earlier_s: float = 0.0
    seconds: float = 0.0
    decisions: list[dict] = field(default_factory=list)
    barren: Counter[int] = field(default_factory=Counter)

    @property
    def is_sound(self) -> bool:
        """Whether the newest update of every seed taught something."""
        return not any(self.barren.values())


def compile_chunk(
    program: Built,
    schedule: Schedule,
    state: Any,
    meanwhile: Callable[[], None] | None = None,
) -> Compiled:
    """Compiles `seeds.train_chunk` ahead of time.

    Args:
      program: the compiled side.
      schedule: the curriculum's numbers.
      state: [N] a state, or what `jax.eval_shape` gives of one.
      meanwhile: is called in a thread when Python has traced the program and XLA compiles it.

    Returns:
      The program to call.
    """
    began = time.perf_counter()
    groups = programs.groups(program.config, provenance.cores())
    chunk = mesh.jit_chunk(program)
    part = jax.eval_shape(partial(seeds.split, parts=groups), state)[0]
    lowered = chunk.lower(schedule, part, np.int32(1))
    if meanwhile is not None:
        threading.Thread(target=meanwhile, daemon=True).start()
    fixed = program.config.run.deterministic
    call = lowered.compile(loop.compiler_options(deterministic=fixed))
    found = call.memory_analysis()
    assert found is not None  # both CPU and GPU tell
    # What is returned lies where the donated state lay, but for the metrics.
    returned = found.output_size_in_bytes - found.alias_size_in_bytes
    work = groups * (found.temp_size_in_bytes + returned)
    if groups > 1:
        call = partial(_call_at_once, call, groups)
    seconds = time.perf_counter() - began
    return Compiled(call, seconds, groups * found.argument_size_in_bytes, work)


def _import_ahead() -> None:
    """Imports what a run needs when it saves, while XLA leaves Python idle: half a second."""
    with contextlib.suppress(ImportError):  # whoever needs it says so
        importlib.import_module("orbax.checkpoint")


def _call_at_once(
    call: Callable[..., Any], groups: int, schedule: Schedule, state: TrainState, n: np.int32
) -> tuple[TrainState, dict]:
    """Calls the program of a group of seeds in a thread for each: XLA uses one core for it."""

    def one(part: TrainState) -> tuple[TrainState, dict]:
        return jax.block_until_ready(call(schedule, part, n))

    parts = jax.jit(seeds.split, static_argnums=1)(state, groups)
    with ThreadPoolExecutor(groups) as pool:
        return jax.jit(seeds.join)(list(pool.map(one, parts)))


def prepare(
    program: Built, schedule: Schedule, state: TrainState, available: int | None
) -> tuple[Compiled, TrainState]:
    """Compiles, and takes all the memory that training needs, so that nothing can lack it later.

    Args:
      program: the compiled side.
      schedule: the curriculum's numbers.
      state: [N] where to start; donated.
      available: memory of the device, bytes; None if it is not known.

    Returns:
      The program to call, its `seconds` with those that Warp's kernels took, and the same state.

    Raises:
      ConfigError: if it needs more than there is.
    """
    compiled = compile_chunk(program, schedule, state, _import_ahead)
    memory.check(program.config, compiled.total_bytes, available)
    seconds = compiled.seconds + _build_kernels(program, state)
    # A call of no updates changes nothing, but takes what the program works with.
    state, _ = jax.block_until_ready(compiled.call(schedule, state, np.int32(0)))
    return replace(compiled, seconds=seconds), state


def measure(settings: TrainConfig) -> int:
    """Compiles a config's program and returns the device memory that training needs, bytes."""
    program, schedule = programs.load(settings, by_robot=settings.run.episodes)
    template = jax.eval_shape(mesh.init(program), schedule)
    return compile_chunk(program, schedule, template).total_bytes


def train(
    run: Path,
    program: Built,
    schedule: Schedule,
    compiled: Compiled,
    state: TrainState,
    display: Display,
    stop: Stop,
    kept: Kept | None = None,
) -> tuple[TrainState, Tally]:
    """Trains until the budget is spent, `run.stop_after` is reached or somebody asks to stop.

    A checkpoint is written before the first update, by time, by share of the budget, and at the
    end; a thread writes it while training goes on.

    Args:
      run: the run directory.
      program: the compiled side.
      schedule: the curriculum's numbers.
      compiled: the program to call, as `prepare` made it.
      state: [N] where to start; donated.
      display: shows the run.
      stop: notices signals.
      kept: the checkpoint that the state is of; None for a run that begins.

    Returns:
      The last state, which is saved, and what came of the run.

    Raises:
      DivergedError: if a seed learned nothing in `PATIENCE` updates in a row; the checkpoint before
        them is kept.
      TrainingError: if the directory cannot be written.
    """
    settings, done = program.config, int(state.update[0])
    tally = begin_tally(settings, done, compiled.seconds, run, kept)
    keep, resumed = settings.run.keep_checkpoints, None if kept is None else done
    with (
        _recorder(run, program, done, kept) as record,
        Checkpoints(run, keep, resumed) as checkpoints,
    ):
        saves, keeps = Saves(settings, done), settings.run.checkpoint_arenas
        save = partial(
            checkpoints.save,
            rate_scale=1.0 if kept is None else kept.rate_scale,
            of={"budget": settings.budget, "streams": settings.stream_count, "arenas": keeps},
        )
        what = partial(_saved_part, arenas=keeps)
        save(what(state), done, record.sync())  # nothing is done if it is there
        for n in _calls(program, tally, stop):
            began = time.perf_counter()
            state, metrics = compiled.call(schedule, state, np.int32(n))
            metrics = jax.device_get(hosts.gather(metrics))
            _report(program, tally, metrics, n, time.perf_counter() - began, record, display)
            due = saves.due(tally, checkpoints.write_seconds)
            if tally.is_sound and hosts.share(due)[0]:
                save(what(state), tally.update, record.sync(), score(settings, tally))
            if saves.must_wait(tally):
                checkpoints.wait()
        save(what(state), tally.update, record.sync(), score(settings, tally))
    return state, tally


def _saved_part(state: TrainState, *, arenas: bool) -> Any:
    """Leaves the arenas out of what is saved, where the config says so."""
    return state if arenas else replace(state, arenas=None)


class Saves:
    """Says when a checkpoint is due, by time and by share of the budget, and when to wait for one.

    A run that is killed while it writes a checkpoint goes back to the one before. So that a kill
    repeats one interval at most, a checkpoint is begun early: by the time that the last one took
    to write and the next call takes, at most by half of the interval. If it takes longer than
    that, the run waits for it.
    """

    def __init__(self, settings: TrainConfig, done: int) -> None:
        """Begins to count where `done` updates are done."""
        self._seconds = 60.0 * settings.run.checkpoint_minutes
        self._updates = settings.run.checkpoint_share * settings.updates
        self._last = self._before = (time.monotonic(), done)  # checkpoints, the newest and before
        self._update = done
        self._call = 0

    def due(self, tally: Tally, write_seconds: float) -> bool:
        """Tells whether to save now; if so, the next checkpoint is counted from here.

        Args:
          tally: after a call of the program.
          write_seconds: that the last checkpoint took to write.
        """
        self._call, self._update = tally.update - self._update, tally.update
        late = self._call + write_seconds / _pace(tally)  # updates until it is written
        due = self._is_over(self._last, tally, late, most=0.5)
        if due:
            self._last, self._before = (time.monotonic(), tally.update), self._last
        return due

    def must_wait(self, tally: Tally) -> bool:
        """Tells whether the next call ends later than an interval after the checkpoint before."""
        return self._is_over(self._before, tally, self._call, most=1.0)

    def _is_over(
        self, since: tuple[float, int], tally: Tally, ahead: float, *, most: float
    ) -> bool:
        """Tells whether an interval is over in `ahead` updates, or in `most` of it."""
        seconds, updates = time.monotonic() - since[0], tally.update - since[1]
        by_time = seconds + min(ahead * _pace(tally), most * self._seconds) > self._seconds
        by_share = updates + min(ahead, most * self._updates) > self._updates
        return by_time or (self._updates > 0 and by_share)


def _pace(tally: Tally) -> float:
    """Returns the seconds that an update takes."""
    return tally.seconds / (tally.update - tally.first)


def score(settings: TrainConfig, tally: Tally) -> float | None:
    """Rates what a run has learned, so that its best checkpoint can be kept.

    Returns:
      The mean over the seeds of the furthest stage measured, counted from 0, plus the share of
      its targets that were reached; None before every seed was measured.
    """
    names = [stage.name for stage in settings.stage]
    found = [
        max((names.index(name) + share for name, share in of_seed.items()), default=None)
        for of_seed in tally.targets_reached.values()
    ]
    rated = [each for each in found if each is not None]
    return None if len(rated) < len(found) else sum(rated) / len(rated)


def begin_tally(
    settings: TrainConfig, done: int, compile_s: float, run: Path, kept: Kept | None = None
) -> Tally:
    """Begins to add up, from what a resumed run had come to.

    Args:
      settings: of the run.
      done: updates of every seed that are done.
      compile_s: that compiling took.
      run: directory that holds the logs of a run that goes on.
      kept: the checkpoint that the run goes on from, if one.

    Returns:
      The tally before the first update of this process.

    Raises:
      CheckpointError: if a log of the run that goes on is damaged.
    """
    numbers = seeds.numbers(settings)
    tally = Tally(
        update=done,
        first=done,
        compile_s=compile_s,
        transitions=dict.fromkeys(numbers, 0),
        targets_reached={seed: {} for seed in numbers},
    )
    if kept is None:
        return tally
    rows, decisions = recorder.history(run, done, kept.logs)
    try:
        _add(settings, tally, rows, decisions)
        tally.earlier_s = float(rows[-1]["train_s"]) if rows else 0.0
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{run / METRICS} is damaged ({type(error).__name__}: {error}): put the file back, or "
            "delete it to go on without its rows."
        ) from None
    return tally


def _add(settings: TrainConfig, tally: Tally, rows: list[Row], decisions: list[Row]) -> None:
    """Adds rows and decisions to the tally."""
    names = [stage.name for stage in settings.stage]
    for row in rows:
        tally.transitions[row["seed"]] += row["transitions"]
    for row in rows[-settings.seeds :]:
        shares = zip(names, row["success_by_stage"], strict=True)
        tally.targets_reached[row["seed"]] = {k: share for k, share in shares if share is not None}
    tally.decisions += [entry for entry in decisions if "to" in entry]


def _recorder(run: Path, program: Built, done: int, kept: Kept | None) -> Recorder:
    """Opens what the run writes, where `done` updates are done."""
    settings = program.config
    return Recorder(
        run,
        seeds=seeds.numbers(settings),
        tensorboard=settings.run.tensorboard,
        episodes=settings.run.episodes,
        update=done,
        arena_steps=done * settings.arenas * settings.algo.rollout_length,
        logs=None if kept is None else kept.logs,
        loggers=[WandbRuns(settings, run)] if settings.run.wandb and hosts.is_first() else [],
    )


def _build_kernels(program: Built, state: TrainState) -> float:
    """Builds Warp's kernels before the clock of training starts; returns the seconds it took."""
    began = time.perf_counter()
    loaded = program.world.physics
    if loaded.engine.builds_kernels:
        physics.build_kernels(loaded, mesh.stepped_together(program, state))
    return time.perf_counter() - began


def _calls(program: Built, tally: Tally, stop: Stop) -> Iterator[int]:
    """Yields how many updates the next call does, until there is nothing left to do."""
    settings = program.config
    goal = settings.updates
    if settings.run.stop_after is not None:
        goal = min(goal, settings.run.stop_after)
    n = 1
    while tally.update < goal and not stop_together(stop):
        left = min(goal - tally.update, program.rows)
        if settings.run.chunk == "all" and not tally.seconds:
            n = min(left, FIRST_UPDATES)
        elif settings.run.chunk == "all":
            n = min(left, max(1, int(ALL_SECONDS * (tally.update - tally.first) / tally.seconds)))
        elif settings.run.chunk != "auto":
            n = settings.run.chunk
        elif tally.seconds:
            pace = tally.seconds / (tally.update - tally.first)
            n = int(np.clip(CALL_SECONDS / pace, 1, GROWTH * n))
        yield int(hosts.share(min(n, left))[0])


def stop_together(stop: Stop) -> bool:
    """Tells whether a process of the run was asked to stop; all then end with the same code."""
    if hosts.count() == 1:
        return stop.asked
    asked = hosts.share((stop.code or 1) if stop.asked else 0).max()
    if asked > 1 and stop.code is None:
        stop.code = int(asked)
    return bool(asked)


def _report(
    program: Built,
    tally: Tally,
    metrics: dict[str, Any],
    n: int,
    seconds: float,
    record: Recorder,
    display: Display,
) -> None:
    """Adds a call to the tally, writes it and its episodes down, and shows it."""
    settings, log = program.config, metrics.pop(episodes.KEY, None)
    names = [stage.name for stage in settings.stage]
    control_steps = settings.arenas * settings.algo.rollout_length
    tally.update += n
    tally.seconds += seconds
    rows = recorder.rows(metrics, n, names, seeds.numbers(settings), control_steps)
    rows: list[Row] = [row | {"train_s": tally.earlier_s + tally.seconds} for row in rows]
    decisions = _decisions(settings, rows)
    speeds = _speeds(program, rows, seconds) | {"compile_s": tally.compile_s}
    _add(settings, tally, rows, decisions)
    record.write(rows, decisions, speeds)
    _watch_steps(settings, tally, rows)
    for entry in decisions:
        if "to" in entry:  # the rest is many, and stands in the log
            display.say(_sentence(settings, entry))
    pace = tally.seconds / (tally.update - tally.first)
    display.hear(rows, speeds)
    display.show(summarize(rows, names), speeds, pace * (settings.updates - tally.update))
    if log is not None:
        _log_episodes(settings, log, np.arange(tally.update)[-n:], record, display)


def _log_episodes(
    settings: TrainConfig,
    log: episodes.EpisodeLog,
    updates: np.ndarray,
    record: Recorder,
    display: Display,
) -> None:
    """Writes the episodes of a call down."""
    names, numbers = [stage.name for stage in settings.stage], seeds.numbers(settings)
    steps = settings.arenas * settings.algo.rollout_length
    rows, lost = episodes.rows(log, updates, names, numbers, steps)
    record.write_episodes(rows)
    if lost:
        display.say(
            f"{EPISODES} lacks {words.count(lost, 'episode')} up to update "
            f"{updates[-1]:,}: more ended than there was room for."
        )


def _decisions(settings: TrainConfig, rows: list[Row]) -> list[Row]:
    """Says what the curricula of all seeds decided, in the order of the updates."""
    names, several = [stage.name for stage in settings.stage], settings.seeds
    found = [
        entry
        for lane, seed in enumerate(seeds.numbers(settings))
        for entry in log(rows[lane::several], names, seed)
    ]
    return sorted(found, key=lambda entry: entry["update"])


def _watch_steps(settings: TrainConfig, tally: Tally, rows: list[Row]) -> None:
    """Counts the updates in a row that taught nothing; too many end the run."""
    for row in rows:
        seed, skipped = row["seed"], row["policy_loss"] is None or _broke(settings, row)
        tally.barren[seed] = tally.barren[seed] + 1 if skipped else 0
        if tally.barren[seed] >= PATIENCE:
            raise DivergedError(_diverged(settings, tally, row))


def _diverged(settings: TrainConfig, tally: Tally, row: Row) -> str:
    where = f" of seed {row['seed']}" if settings.seeds > 1 else ""
    count = words.count(tally.barren[row["seed"]], "update")
    last = f"in {count} up to update {row['update'] + 1:,}."
    if _broke(settings, row):
        return f"every arena{where} broke at every step {last}"
    return f"no gradient step{where} was finite {last}"


def _broke(settings: TrainConfig, row: Row) -> bool:
    """Tells whether no step of any arena of an update was finite."""
    return row["broken_arenas"] >= settings.arenas * settings.algo.rollout_length


def _speeds(program: Built, rows: list[Row], seconds: float) -> dict[str, float]:
    """Speeds of a call: arena, robot and physics steps, and transitions, of all seeds a second."""
    settings = program.config
    arena_steps = len(rows) * settings.arenas * settings.algo.rollout_length
    substeps = physics_substeps(settings.robot, settings.sim.substeps)
    return {
        "arena_steps_per_s": arena_steps / seconds,
        "robot_steps_per_s": settings.algo.rollout_length
        * sum(row["robots"] for row in rows)
        / seconds,
        "physics_steps_per_s": arena_steps * substeps / seconds,
        "transitions_per_s": sum(row["transitions"] for row in rows) / seconds,
    }


def _sentence(settings: TrainConfig, entry: Row) -> str:
    """Says in one line what the curriculum decided."""
    seed = f"seed {entry['seed']}, " if settings.seeds > 1 else ""
    share = entry["targets_reached"]
    success = "not measured yet" if share is None else f"{100 * share:.1f} % of targets reached"
    return (
        f"{seed}update {entry['update'] + 1}: {entry['from']} -> {entry['to']} by {entry['why']} "
        f"({success})"
    )
