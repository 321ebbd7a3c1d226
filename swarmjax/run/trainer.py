"""The host's training loop: calls the compiled chunk, records, displays, saves and stops."""

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
from swarmjax.run.errors import CheckpointError, DivergedError, TrainingError
from swarmjax.run.loggers import Logger
from swarmjax.run.recorder import Recorder
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop
from swarmjax.run.tensorboard import Boards
from swarmjax.run.weights_and_biases import WandbRuns
from swarmjax.sim import physics
from swarmjax.sim.config import physics_substeps
from swarmjax.training import episodes, loop, mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.program import Program

Built = Program[TrainConfig]  # the program of a run

CALL_SECONDS = 1.0  # target length of a call with run.chunk=auto: the display's refresh interval
ALL_SECONDS = 10.0  # longest call with run.chunk=all: a signal waits up to this long
# Updates in the first call with run.chunk=all. The pace of this call sets the other calls' length.
FIRST_UPDATES = 32
PATIENCE = 10  # a run has diverged after this many updates in a row without learning
GROWTH = 4  # a call is at most this many times as long as the previous one


@dataclass(frozen=True)
class Compiled:
    """The compiled chunk, the time to compile it, and the memory that it needs.

    Attributes:
      call: (schedule, state [N], n) -> (state [N], metrics [N, rows]). The state is donated.
      seconds: time spent tracing and compiling.
      state_bytes: device memory for the training state.
      work_bytes: device memory that the program needs beyond the state.
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
    """Totals over the whole run, kept on the host in integers that do not wrap.

    Attributes:
      update: updates that every seed has done.
      first: updates that were done when this process began.
      compile_s: seconds spent compiling.
      transitions: robot steps that each seed was trained on.
      targets_reached: share of targets reached on each stage, as last measured, by seed.
      earlier_s: seconds of training before this process began.
      seconds: seconds of training in this process, without compilation.
      decisions: promotions.
      barren: how many of the newest updates in a row taught nothing, by seed. In such an update
        every gradient step was skipped, or every arena broke at every step.
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
    """Compiles `seeds.chunk` ahead of time.

    Args:
      program: the run's program.
      schedule: the curriculum's numbers.
      state: [N] a state, or its shapes from `jax.eval_shape`.
      meanwhile: called in a thread after Python has traced the program, while XLA compiles it.

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
    assert found is not None  # both CPU and GPU report it
    # The returned state reuses the memory of the donated state. Only the metrics need more memory.
    returned = found.output_size_in_bytes - found.alias_size_in_bytes
    work = groups * (found.temp_size_in_bytes + returned)
    if groups > 1:
        call = partial(_call_at_once, call, groups)
    seconds = time.perf_counter() - began
    return Compiled(call, seconds, groups * found.argument_size_in_bytes, work)


def _import_ahead() -> None:
    """Imports Orbax (half a second) while XLA compiles and Python is idle."""
    with contextlib.suppress(ImportError):  # the code that needs it reports the error
        importlib.import_module("orbax.checkpoint")


def _call_at_once(
    call: Callable[..., Any], groups: int, schedule: Schedule, state: TrainState, n: np.int32
) -> tuple[TrainState, dict]:
    """Runs each group of seeds in a thread of its own, because XLA uses one core per group."""

    def one(part: TrainState) -> tuple[TrainState, dict]:
        return jax.block_until_ready(call(schedule, part, n))

    parts = jax.jit(seeds.split, static_argnums=1)(state, groups)
    with ThreadPoolExecutor(groups) as pool:
        return jax.jit(seeds.join)(list(pool.map(one, parts)))


def prepare(
    program: Built, schedule: Schedule, state: TrainState, available: int | None
) -> tuple[Compiled, TrainState]:
    """Compiles the program and claims all memory for training, so that it cannot run out later.

    Args:
      program: the run's program.
      schedule: the curriculum's numbers.
      state: [N] the first state; donated.
      available: memory of the device, bytes; None if unknown.

    Returns:
      The program to call and the same state. The program's `seconds` include the time to build
      Warp's kernels.

    Raises:
      ConfigError: if training needs more memory than there is.
    """
    compiled = compile_chunk(program, schedule, state, _import_ahead)
    memory.check(program.config, compiled.total_bytes, available)
    seconds = compiled.seconds + _build_kernels(program, state)
    # A call with zero updates changes nothing, but allocates the program's working memory.
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
    """Trains until the budget is spent, `run.stop_after` is reached or a stop is requested.

    Writes checkpoints before the first update, by time, by share of the budget, and at the end. A
    thread writes them while training continues.

    Args:
      run: the run directory.
      program: the run's program.
      schedule: the curriculum's numbers.
      compiled: the program to call, as `prepare` made it.
      state: [N] the first state; donated.
      display: shows the run.
      stop: notices signals.
      kept: the checkpoint that the state comes from; None for a new run.

    Returns:
      The last state, which is saved, and the totals of the run.

    Raises:
      DivergedError: if a seed learned nothing in `PATIENCE` updates in a row. The checkpoint before
        these updates is kept.
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
        save(what(state), done, record.sync())  # does nothing if this update is already saved
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
    """Drops the arenas from the state to save, if the config says so."""
    return state if arenas else replace(state, arenas=None)


class Saves:
    """Decides when to write a checkpoint, by time and by share of the budget, and when to wait.

    A run that is killed while it writes a checkpoint goes back to the previous checkpoint. A kill
    should cost at most one interval of training. So each checkpoint begins early. Its lead is the
    time that the last checkpoint took to write, plus the length of the next call. The lead is at
    most half the interval. If writing takes longer than that, the run waits until it is done.
    """

    def __init__(self, settings: TrainConfig, done: int) -> None:
        """Starts to count after `done` updates."""
        self._seconds = 60.0 * settings.run.checkpoint_minutes
        self._updates = settings.run.checkpoint_share * settings.updates
        self._last = self._before = (time.monotonic(), done)  # the newest and previous checkpoint
        self._update = done
        self._call = 0

    def due(self, tally: Tally, write_seconds: float) -> bool:
        """Returns whether to save now. If so, the next interval starts here.

        Args:
          tally: the totals after a call of the program.
          write_seconds: time to write the last checkpoint.
        """
        self._call, self._update = tally.update - self._update, tally.update
        late = self._call + write_seconds / _pace(tally)  # updates until the checkpoint is written
        due = self._is_over(self._last, tally, late, most=0.5)
        if due:
            self._last, self._before = (time.monotonic(), tally.update), self._last
        return due

    def must_wait(self, tally: Tally) -> bool:
        """Returns whether the next call ends more than an interval after the save before last."""
        return self._is_over(self._before, tally, self._call, most=1.0)

    def _is_over(
        self, since: tuple[float, int], tally: Tally, ahead: float, *, most: float
    ) -> bool:
        """Returns whether an interval since `since` ends within the next `ahead` updates.

        `ahead` counts for at most the fraction `most` of the interval.
        """
        seconds, updates = time.monotonic() - since[0], tally.update - since[1]
        by_time = seconds + min(ahead * _pace(tally), most * self._seconds) > self._seconds
        by_share = updates + min(ahead, most * self._updates) > self._updates
        return by_time or (self._updates > 0 and by_share)


def _pace(tally: Tally) -> float:
    """Returns the mean seconds per update in this process."""
    return tally.seconds / (tally.update - tally.first)


def score(settings: TrainConfig, tally: Tally) -> float | None:
    """Rates what a run has learned, so that its best checkpoint can be kept.

    A seed's score is the index of its furthest measured stage, counted from 0, plus the share of
    targets reached there.

    Returns:
      The mean score over the seeds; None until every seed has been measured.
    """
    names = settings.stage_names
    found = [
        max((names.index(name) + share for name, share in of_seed.items()), default=None)
        for of_seed in tally.targets_reached.values()
    ]
    rated = [each for each in found if each is not None]
    return None if len(rated) < len(found) else sum(rated) / len(rated)


def begin_tally(
    settings: TrainConfig, done: int, compile_s: float, run: Path, kept: Kept | None = None
) -> Tally:
    """Starts the totals of a run. A resumed run continues the totals in its logs.

    Args:
      settings: the run's config.
      done: updates that every seed has done.
      compile_s: seconds spent compiling.
      run: the directory with the logs of a resumed run.
      kept: the checkpoint that the run resumes from, if any.

    Returns:
      The tally before the first update of this process.

    Raises:
      CheckpointError: if a log of the resumed run is damaged.
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
    names = settings.stage_names
    for row in rows:
        tally.transitions[row["seed"]] += row["transitions"]
    for row in rows[-settings.seeds :]:
        shares = zip(names, row["success_by_stage"], strict=True)
        tally.targets_reached[row["seed"]] = {k: share for k, share in shares if share is not None}
    tally.decisions += [entry for entry in decisions if "to" in entry]


def _recorder(run: Path, program: Built, done: int, kept: Kept | None) -> Recorder:
    """Opens the logs of a run that has done `done` updates."""
    settings = program.config
    return Recorder(
        run,
        episodes=settings.run.episodes,
        update=done,
        logs=None if kept is None else kept.logs,
        loggers=_loggers(run, settings, done),
    )


def _loggers(run: Path, settings: TrainConfig, done: int) -> list[Logger]:
    """Makes the loggers that a config names, for a run that has done `done` updates."""
    found: list[Logger] = []
    if settings.run.tensorboard:
        steps = done * settings.arenas * settings.algo.rollout_length
        purge = steps + 1 if done else None
        found.append(Boards(run, settings.numbers, settings.stage_names, purge))
    if settings.run.wandb and hosts.is_first():
        found.append(WandbRuns(settings, run))
    return found


def _build_kernels(program: Built, state: TrainState) -> float:
    """Builds Warp's kernels before training time is counted, and returns the seconds it took."""
    began = time.perf_counter()
    loaded = program.world.physics
    if loaded.engine.builds_kernels:
        physics.build_kernels(loaded, mesh.stepped_together(program, state))
    return time.perf_counter() - began


def _calls(program: Built, tally: Tally, stop: Stop) -> Iterator[int]:
    """Yields the number of updates for each call, until the run is done or should stop."""
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
    """Returns whether any process of the run was asked to stop.

    All processes then exit with the same code.
    """
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
    """Adds a call to the tally, logs it and its episodes, and shows it."""
    settings, log = program.config, metrics.pop(episodes.KEY, None)
    names = settings.stage_names
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
        if "to" in entry:  # the other decisions are many and only go to the log
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
    """Writes the episodes of a call to their log."""
    names, numbers = settings.stage_names, seeds.numbers(settings)
    steps = settings.arenas * settings.algo.rollout_length
    rows, lost = episodes.rows(log, updates, names, numbers, steps)
    record.write_episodes(rows)
    if lost:
        display.say(
            f"{EPISODES} lacks {words.count(lost, 'episode')} up to update "
            f"{updates[-1]:,}: more episodes ended than the buffer can hold."
        )


def _decisions(settings: TrainConfig, rows: list[Row]) -> list[Row]:
    """Returns the curriculum's decisions for all seeds, in the order of the updates."""
    names, several = settings.stage_names, settings.seeds
    found = [
        entry
        for lane, seed in enumerate(seeds.numbers(settings))
        for entry in log(rows[lane::several], names, seed)
    ]
    return sorted(found, key=lambda entry: entry["update"])


def _watch_steps(settings: TrainConfig, tally: Tally, rows: list[Row]) -> None:
    """Counts the updates in a row that taught nothing, and ends the run after too many."""
    for row in rows:
        broken, skipped = row["broken_arenas"], row["skipped_steps"]
        if jax.config.jax_debug_nans and (broken or skipped):
            raise TrainingError(
                f"update {row['update'] + 1:,} had numbers that are not finite, in "
                f"{words.count(broken, 'arena')} and {words.count(int(skipped), 'gradient step')}. "
                "JAX_DEBUG_NANS is on, so the run stops; look at the functions of extensions first."
            )
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
    """Returns whether every arena broke at every step of an update."""
    return row["broken_arenas"] >= settings.arenas * settings.algo.rollout_length


def _speeds(program: Built, rows: list[Row], seconds: float) -> dict[str, float]:
    """Returns a call's speeds per second, over all seeds.

    The speeds count arena steps, robot steps, physics steps and transitions.
    """
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
    """Describes a decision of the curriculum in one line."""
    seed = f"seed {entry['seed']}, " if settings.seeds > 1 else ""
    share = entry["targets_reached"]
    success = "not measured yet" if share is None else f"{100 * share:.1f} % of targets reached"
    return (
        f"{seed}update {entry['update'] + 1}: {entry['from']} -> {entry['to']} by {entry['why']} "
        f"({success})"
    )
