"""A training run, from its settings to its finished directory. Read `Run.train` first."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import jax
import numpy as np

from swarmjax import outputs, words
from swarmjax.config import ConfigError, reading, to_dict
from swarmjax.curriculum.engine import Schedule
from swarmjax.curriculum.log import log
from swarmjax.run import (
    checkpoint,
    compile_cache,
    directory,
    hosts,
    memory,
    recorder,
    results,
    sentences,
    traces,
    warm_start,
    weights_and_biases,
)
from swarmjax.run.checkpoint import Checkpoints, Kept
from swarmjax.run.compiled import Compiled, compile_chunk
from swarmjax.run.directory import EPISODES, METRICS, Row
from swarmjax.run.display import Display, figures
from swarmjax.run.errors import TrainingError
from swarmjax.run.load_settings import read_config
from swarmjax.run.loggers import Logger
from swarmjax.run.policy_export import POLICY, seed_path
from swarmjax.run.recorder import Recorder
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop
from swarmjax.run.tensorboard import Boards
from swarmjax.run.weights_and_biases import WandbRuns
from swarmjax.sim import physics
from swarmjax.training import episodes, mesh
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Program

CALL_SECONDS = 1.0  # target length of a call with run.chunk=auto: the display's interval
# Save a checkpoint at least once per this share of the budget, so that short runs have some too.
BUDGET_SHARE = 0.1
GROWTH = 4  # a call is at most this many times as long as the previous one
PATIENCE = 10  # a run has diverged after this many updates in a row without learning


class Run:
    """A training run.

    Attributes:
      settings: its config.
      path: its directory, once it is open.
      program: the parts that determine the compiled program, once it is loaded.
      schedule: the curriculum's numbers, an argument of the program.
      state: [N] the training state.
      compiled: the program to call, once it is compiled.
      update: updates that every seed has done.
    """

    program: Program[TrainConfig]
    schedule: Schedule
    state: Any
    compiled: Compiled

    def __init__(
        self,
        settings: TrainConfig,
        *,
        stop: Stop | None = None,
        display: Display | None = None,
        loggers: Sequence[Logger] = (),
        on_update: Callable[[Row], object] | None = None,
        keep_traces: bool = False,
    ) -> None:
        """Prepares a run, but does nothing yet.

        Args:
          settings: the config.
          stop: notices signals; None: the run cannot be stopped.
          display: shows the run; None: nothing is shown.
          loggers: receive the rows, in addition to the loggers that the config names.
          on_update: called with a copy of each row; it returns True to stop the run.
          keep_traces: whether to keep traced programs for later runs. Only for a new process: its
            code is that of the files, and their digest is the key.
        """
        self.settings = settings
        self._stop = stop or Stop()
        self._display = display or Display(quiet=True)
        self._loggers, self._on_update = loggers, on_update or (lambda row: None)
        self._keep_traces = keep_traces
        self.path, self.update = Path(), 0
        self._kept: Kept | None = None
        self._first, self._seconds, self._earlier_s = 0, 0.0, 0.0
        self._newest: list[Row] = []  # the last row of each seed
        self._barren: Counter[int] = Counter()  # updates in a row without learning, by seed
        self._saved = (0.0, 0)  # time and update of the newest checkpoint

    def train(self) -> None:
        """Trains the run and writes its directory; with `resume` the run goes on.

        Raises:
          ConfigError: if the config cannot be run, training needs more memory than there is, or
            another process is writing the directory.
          CheckpointError: if the checkpoint or logs of a resumed run are damaged.
          TrainingError: if the run diverges, or its directory can no longer be written.
          LostPeerError: if another process of the run is gone.
          StoppedError: if a stop was requested before there was anything to save.
        """
        hosts.join(self.settings)
        refusal = memory.refusal(self.settings)
        with compile_cache.use(), hosts.lost_peers(), refusal, self._directory():
            self.load()
            if not self._has_ended():
                self.compile()
            if not self._is_finished():
                self._open_files()
                self._train_chunks()
                self._write_results()
            self._display.say(sentences.success(self.settings, self._newest))
            ended = self._has_ended()
            self._display.say(sentences.closing(self.settings, self.path, self.update, ended=ended))

    @contextmanager
    def _directory(self) -> Iterator[None]:
        """Makes or opens the run directory, and keeps other processes out of it."""
        weights_and_biases.check(self.settings)
        chosen = self._choose_path() if hosts.is_first() else Path()
        claimed = self.settings.run.dir is None
        with hosts.own_directory(chosen) as self.path, directory.locked(self.path, claimed=claimed):
            if hosts.is_first():  # the other processes' folders link to the first one's checkpoints
                check_free(self.path, self.settings)
            name = self.settings.run.id or hosts.share_text(directory.new_id())
            self.settings = replace(self.settings, run=replace(self.settings.run, id=name))
            try:
                yield
            except (OSError, TrainingError) as error:
                raise self._broken(error) from None

    def _choose_path(self) -> Path:
        """Returns the run directory that the config names, or makes one."""
        if self.settings.run.dir is not None:
            check_free(Path(self.settings.run.dir), self.settings)
            return Path(self.settings.run.dir)
        every = self.settings.numbers
        seed = f"seed{every[0]}" if len(every) == 1 else f"seeds{every[0]}-{every[-1]}"
        name = f"{datetime.now():%Y%m%d-%H%M%S}-{self.settings.stage_name}-{seed}"
        try:
            return directory.claim(Path("runs"), name)
        except OSError as error:
            raise outputs.unwritable("run.dir", Path("runs") / name, error) from None

    def _broken(self, error: OSError | TrainingError) -> TrainingError:
        """Says why the run ends, and where its checkpoints are."""
        why = str(error)
        if isinstance(error, OSError):
            why = f"{self.path} cannot be written: {error.strerror or error}."
        saved = f" What was saved before is in {self.path}." if checkpoint.steps(self.path) else ""
        return TrainingError(f"{why}{saved}")

    def load(self) -> None:
        """Builds the program and the first state, from the seed or from a checkpoint."""
        self._stop.check()
        settings, self._kept = self.settings, self._read_checkpoint()
        source = warm_start.read(settings) if self._kept is None else None
        for sentence in sentences.first(settings, self.path, self._kept, source):
            self._display.say(sentence, width=100)
        with self._display.busy("building the arenas"):
            self.program, self.schedule = programs.load(settings, by_robot=settings.run.episodes)
            init, given = jax.jit(mesh.init(self.program)), (self.schedule, mesh.lanes(settings))
            if self._keep_traces:
                init = traces.keep(self.program, "init", init, given)
            self.state = self._first_state(init, given, source)
        if settings.run.verbose:
            self._display.say(sentences.details(self.program))
        if self._has_ended():
            self._display.say(sentences.nothing_left(settings, self.update))

    def _read_checkpoint(self) -> Kept | None:
        """Reads the newest sound checkpoint of the resumed run, if there is one."""
        settings = self.settings
        if settings.resume is None or not checkpoint.steps(Path(settings.resume)):
            return None
        kept = checkpoint.find(Path(settings.resume))
        if kept.update > settings.updates:
            spent = kept.update * settings.arenas * settings.algo.rollout_length
            raise ConfigError(
                f"budget is {settings.budget}, but {settings.resume} has spent {spent} already: "
                "give at least that."
            )
        past = directory.read_rows(Path(settings.resume) / METRICS, kept.logs.get(METRICS, 0))
        self._newest = past[-settings.seeds :]
        self._earlier_s = self._newest[-1]["train_s"] if past else 0.0
        self.update = self._first = kept.update
        return kept

    def _first_state(
        self, init: Any, given: tuple[Schedule, np.ndarray], source: Kept | None
    ) -> TrainState:
        if self._kept is None:
            state = init(*given)
            return state if source is None else warm_start.carry(source, state, self.settings)
        shapes = init.eval_shape(*given)
        return mesh.put(self.program, checkpoint.from_leaves(self._kept.leaves, shapes))

    def compile(self) -> None:
        """Compiles the program and claims its memory, so that training cannot run out later."""
        self._stop.check()
        began = time.perf_counter()
        with self._display.busy("compiling"):
            compiled = compile_chunk(
                self.program, self.schedule, self.state, keep_trace=self._keep_traces
            )
            memory.check(self.settings, compiled.memory_bytes)
            self._claim(compiled)
        self.compiled = replace(compiled, seconds=time.perf_counter() - began)
        self._stop.check()
        self._display.say(f"compiled in {words.duration(self.compiled.seconds)}")

    def _claim(self, compiled: Compiled) -> None:
        """Builds Warp's kernels, and allocates the program's memory."""
        loaded = self.program.world.physics
        if loaded.engine.builds_kernels:
            physics.build_kernels(loaded, mesh.stepped_together(self.program, self.state))
        # A call with zero updates changes nothing, but allocates the program's working memory.
        self.state, _ = jax.block_until_ready(compiled.call(self.schedule, self.state, np.int32(0)))

    def _has_ended(self) -> bool:
        """Returns whether the budget is spent, or every seed has reached `run.stop_at`."""
        return self.update == self.settings.updates or self._has_reached()

    def _has_reached(self) -> bool:
        """Returns whether `run.stop_at` ends the run now, which is at the end of a cohort."""
        if self.settings.run.stop_at is None or self.update % int(self.schedule.cohort_updates):
            return False
        return bool(hosts.share(results.has_reached(self.settings, self._newest))[0])

    def _is_finished(self) -> bool:
        """Returns whether the run was finished before: it has ended, and all is written."""
        ended = self._has_ended()
        return ended and bool(hosts.share(results.is_current(self.path, self.update))[0])

    def _open_files(self) -> None:
        """Writes `config.json`."""
        stored = to_dict(replace(self.settings, resume=None))
        if self.settings.resume is not None:
            stored = directory.kept_config(read_config(Path(self.settings.resume)), stored)
        try:
            directory.write_json(self.path / directory.CONFIG, stored)
        except OSError as error:
            raise outputs.unwritable("run.dir", self.path, error) from None

    def _train_chunks(self) -> None:
        """Trains until the run has ended, `run.stop_after` is reached or a stop is requested."""
        options, logs = self.settings.run, {} if self._kept is None else self._kept.logs
        resumed = None if self._kept is None else self.update
        with (
            Recorder(
                self.path, logs, episodes=options.episodes, loggers=self._make_loggers()
            ) as record,
            Checkpoints(self.path, resumed) as checkpoints,
        ):
            self._save(checkpoints, record)
            for n in self._chunks():
                began = time.perf_counter()
                self.state, metrics = self.compiled.call(self.schedule, self.state, np.int32(n))
                metrics = jax.device_get(hosts.gather(metrics))
                self._report(metrics, n, time.perf_counter() - began, record)
                if self._is_checkpoint_due():
                    self._save(checkpoints, record)
            self._save(checkpoints, record)

    def _make_loggers(self) -> list[Logger]:
        """Makes the loggers that the config names, beside those that were given."""
        settings, found = self.settings, list(self._loggers)
        if settings.run.tensorboard:
            steps = self.update * settings.arenas * settings.algo.rollout_length
            purge = steps + 1 if self.update else None
            found.append(Boards(self.path, settings.numbers, settings.stage_names, purge))
        if settings.run.wandb and hosts.is_first():
            found.append(WandbRuns(settings, self.path))
        return found

    def _chunks(self) -> Iterator[int]:
        """Yields the number of updates for each call, until the run is done or should stop."""
        settings, n = self.settings, 1
        last = settings.run.stop_after
        goal = settings.updates if last is None else min(settings.updates, last)
        while self.update < goal and not self._has_ended() and not self._must_stop():
            if settings.run.chunk != "auto":
                n = settings.run.chunk
            elif self._seconds:
                n = int(np.clip(CALL_SECONDS / self._pace, 1, GROWTH * n))
            most = min(goal - self.update, self.program.rows)
            if settings.run.stop_at is not None:  # end calls at the end of a cohort
                cohort = int(self.schedule.cohort_updates)
                most = min(most, cohort - self.update % cohort)
            yield int(hosts.share(min(n, most))[0])

    @property
    def _pace(self) -> float:
        """Mean seconds per update in this process."""
        return self._seconds / (self.update - self._first)

    def _must_stop(self) -> bool:
        """Returns whether any process of the run was asked to stop; all get the same exit code."""
        stop = self._stop
        if hosts.count() == 1:
            return stop.asked
        code = int(hosts.share((stop.code or 1) if stop.asked else 0).max())
        if code > 1:
            stop.code = stop.code or code
        return code > 0

    def _report(self, metrics: dict[str, Any], n: int, seconds: float, record: Recorder) -> None:
        """Logs a call and shows it."""
        settings, ended = self.settings, metrics.pop(episodes.KEY, None)
        names, steps = settings.stage_names, settings.arenas * settings.algo.rollout_length
        self.update += n
        self._seconds += seconds
        train_s = {"train_s": self._earlier_s + self._seconds}
        rows: list[Row] = [
            row | train_s for row in recorder.rows(metrics, n, names, settings.numbers, steps)
        ]
        self._newest = rows[-settings.seeds :]
        decisions = [entry for row in rows for entry in log([row], names, row["seed"])]
        speeds = recorder.speeds(settings, rows, seconds) | {"compile_s": self.compiled.seconds}
        record.write(rows, decisions, speeds)
        if ended is not None:
            self._log_episodes(ended, np.arange(self.update - n, self.update), record)
        self._check_learning(rows)
        for sentence in sentences.promotions(settings, decisions):
            self._display.say(sentence)
        left = self._pace * (settings.updates - self.update)
        self._display.show(figures(rows, names), self.update, settings.updates, left, speeds)
        for row in rows:
            self._stop.signalled |= self._on_update(dict(row)) is True

    def _log_episodes(
        self, ended: episodes.EpisodeLog, updates: np.ndarray, record: Recorder
    ) -> None:
        settings = self.settings
        steps = settings.arenas * settings.algo.rollout_length
        rows, lost = episodes.rows(ended, updates, settings.stage_names, settings.numbers, steps)
        record.write_episodes(rows)
        if lost:
            self._display.say(
                f"{EPISODES} lacks {words.count(lost, 'episode')} up to update "
                f"{updates[-1]:,}: more episodes ended than the buffer can hold."
            )

    def _check_learning(self, rows: list[Row]) -> None:
        """Ends the run after `PATIENCE` updates in a row that taught nothing.

        In such an update every gradient step was skipped, or every arena broke at every step.
        """
        steps = self.settings.arenas * self.settings.algo.rollout_length
        for row in rows:
            broke, seed = row["broken_arenas"] >= steps, row["seed"]
            barren = broke or row["policy_loss"] is None
            self._barren[seed] = self._barren[seed] + 1 if barren else 0
            if self._barren[seed] == PATIENCE:
                raise TrainingError(sentences.diverged(self.settings, row, PATIENCE, broke=broke))

    def _is_checkpoint_due(self) -> bool:
        """Returns whether to save now, by time or by share of the budget."""
        options, (when, update) = self.settings.run, self._saved
        by_time = time.monotonic() - when > 60.0 * options.checkpoint_minutes
        by_share = BUDGET_SHARE * self.settings.updates <= self.update - update
        due = bool(hosts.share(by_time or by_share)[0])
        return due and not any(self._barren.values())

    def _save(self, checkpoints: Checkpoints, record: Recorder) -> None:
        """Begins to write a checkpoint, unless this update is saved already."""
        checkpoints.save(self.state, self.update, record.sync())
        self._saved = (time.monotonic(), self.update)

    def _write_results(self) -> None:
        """Writes the policies and the summary; says how good the swarm is and what to do next."""
        leaves = checkpoint.to_leaves(hosts.gather(self.state))
        results.write_policies(self.path, self.settings, leaves, self.update)
        compile_s = self.compiled.seconds if self.update > self._first else 0.0
        reached = self.settings.run.stop_at if self._has_reached() else None
        results.write_summary(self.path, self.program, self.update, compile_s, reached)

    @property
    def policies(self) -> list[Path]:
        """The policy file of each seed."""
        settings = self.settings
        return [seed_path(self.path / POLICY, settings, seed) for seed in settings.numbers]


def check_free(run: Path, settings: TrainConfig) -> None:
    """Refuses a directory that is not empty, unless a run is resumed there."""
    if settings.resume is not None:
        return
    held = directory.visible(run)
    if directory.CONFIG in held:
        raise ConfigError(
            f"run.dir is {run}, which holds a run already: give another directory, or "
            f"resume={run} to go on with it."
        )
    if held:
        raise ConfigError(
            f"run.dir is {run}, which holds {reading.called(held[0])}: give a new or an empty "
            "directory."
        )
