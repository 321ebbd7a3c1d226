"""Carries out a run, from its config to its finished directory."""

import json
import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import jax

from swarmjax import extension, provenance, words
from swarmjax.config import ConfigError, reading, to_dict
from swarmjax.curriculum import engine as curriculum
from swarmjax.curriculum.engine import Schedule
from swarmjax.policy import PolicyError
from swarmjax.ppo import optimizer
from swarmjax.run import checkpoint, directory, hosts, memory, warm_start, weights_and_biases
from swarmjax.run.checkpoint import Checkpoints, Kept, Leaves
from swarmjax.run.display import Display, working
from swarmjax.run.errors import DivergedError, TrainingError
from swarmjax.run.load_settings import from_stored, read_config
from swarmjax.run.policy_export import POLICY, seed_path, write_policy
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop
from swarmjax.run.trainer import Built, Tally, begin_tally, compile_chunk, prepare, train
from swarmjax.task import pieces
from swarmjax.task.config import describe
from swarmjax.training import mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState

_LOWERED = 0.1  # factor on the learning rates of a run that diverged
_GIVE_UP = (
    "The run had already gone back once: give lower algo.actor_learning_rate and "
    "algo.critic_learning_rate, or look at metrics.jsonl for what broke."
)


def carry_out(settings: TrainConfig, run: Path, stop: Stop, display: Display) -> Tally:
    """Trains a run and writes its directory.

    With `resume` the run continues. If its budget is already spent, nothing is compiled, and only
    the missing files of its directory are written.

    Args:
      settings: the config.
      run: the run directory, which must hold no other run.
      stop: notices signals.
      display: shows the run.

    Returns:
      The totals of the run.

    Raises:
      ConfigError: if the config cannot be run, training needs more memory than there is, or another
        process is writing the directory.
      CheckpointError: if the checkpoint or logs of a resumed run are damaged.
      TrainingError: if the run diverges again after it went back once, or its directory can no
        longer be written.
      StoppedError: if a stop was requested before there was anything to save.
    """
    with directory.locked(run, claimed=settings.run.dir is None):
        if hosts.is_first():  # the other processes' folders link to the first one's checkpoints
            check_free(run, settings)
        name = settings.run.id or hosts.share_text(directory.new_id())
        settings = replace(settings, run=replace(settings.run, id=name))
        try:
            return _carry_out(settings, run, stop, display)
        except OSError as error:
            raise TrainingError(f"{run} cannot be written: {error.strerror or error}.") from None


def _carry_out(settings: TrainConfig, run: Path, stop: Stop, display: Display) -> Tally:
    with working("building the arenas"):
        kept = _read_kept(settings)
        source = warm_start.read(settings) if kept is None else None
    if kept is not None and kept.update == settings.updates:
        return _complete(run, settings, kept, display)
    try:
        return _train(settings, run, stop, display, source, kept)
    except DivergedError as error:
        hosts.share(0)  # by now the first process has written its newest checkpoint
        kept = checkpoint.find(run)
        if kept.rate_scale < 1.0:
            raise TrainingError(f"{error} {_GIVE_UP}") from None
        display.say(
            f"{error} The run goes back to update {kept.update:,}, with learning rates of "
            f"{_LOWERED:g} times what they were."
        )
    try:
        return _train(settings, run, stop, display, None, kept._replace(rate_scale=_LOWERED))
    except DivergedError as error:
        raise TrainingError(f"{error} {_GIVE_UP}") from None


def _train(
    settings: TrainConfig,
    run: Path,
    stop: Stop,
    display: Display,
    source: Kept | None,
    kept: Kept | None,
) -> Tally:
    """Trains from a checkpoint, or from the seed, in which case `source` may give the networks."""
    stop.check()
    with working("building the arenas"):
        program, schedule, init, template = _load(_scaled(settings, kept))
        state, skipped = _first_state(program, schedule, init, template, source, kept)
    for sentence in _first_sentences(program, run, source, kept, skipped):
        display.say(sentence)
    for sentence in _short_budget(settings, schedule):
        display.say(sentence)
    stop.check()
    with display.working("compiling"):
        compiled, state = prepare(program, schedule, state, memory.limit())
    display.say(f"compiled in {words.duration(compiled.seconds)}")
    _open_run(run, settings, kept)
    state, tally = train(run, program, schedule, compiled, state, display, stop, kept)
    leaves = checkpoint.to_leaves(hosts.gather(state))
    _write_policies(run, settings, leaves, tally.update)
    _write_summary(run, program, tally)
    return tally


def _scaled(settings: TrainConfig, kept: Kept | None) -> TrainConfig:
    """Lowers the learning rates of a run that diverged once."""
    if kept is None or kept.rate_scale == 1.0:
        return settings
    rates = optimizer.learning_rates(settings.algo, settings.updates)
    lowered = {f"{name}_learning_rate": rate * kept.rate_scale for name, rate in rates.items()}
    return replace(settings, algo=replace(settings.algo, **lowered))


def _first_sentences(
    program: Built, run: Path, source: Kept | None, kept: Kept | None, skipped: list[str]
) -> Iterator[str]:
    """Describes what is trained, which engine steps the robots, and what the run starts from."""
    settings = program.config
    yield f"{_opening(program)}; into {run}"
    if settings.extensions is not None:
        yield f"from {settings.extensions}: {_own_pieces(settings)}"
    for sentence in skipped:
        yield f"{sentence}: it was passed over."
    if settings.resume is not None and kept is None:
        yield f"{settings.resume} has no checkpoint yet: the run begins from its seed."
    if kept is not None and settings.resume is not None:
        yield from _dealt_again(settings)
    if source is not None:
        updates = words.count(source.update, "update")
        as_there = describe(settings.robot, settings.task, settings.realism)
        yield (
            f"starting with the networks and the normaliser of {settings.init_from} after "
            f"{updates}; robot, task, realism and network are as in that run, unless given here: "
            f"{as_there}"
        )


def _dealt_again(settings: TrainConfig) -> Iterator[str]:
    """Yields a sentence if a resumed run has another number of random streams than before."""
    before = from_stored(read_config(Path(settings.resume or ""))).stream_count
    now = settings.stream_count
    if now != before:
        yield (
            f"random numbers are drawn in {words.count(now, 'stream')} from here on, not in "
            f"{before}: what was learned is kept, but the levels drawn from here on differ."
        )


def _read_kept(settings: TrainConfig) -> Kept | None:
    """Reads the newest sound checkpoint of the resumed run, if there is one."""
    if settings.resume is None or not checkpoint.steps(Path(settings.resume)):
        return None
    directory.check_regular(Path(settings.resume))
    kept = checkpoint.find(Path(settings.resume))
    if kept.update > settings.updates:
        spent = kept.update * settings.arenas * settings.algo.rollout_length
        raise ConfigError(
            f"budget is {settings.budget}, but {settings.resume} has spent {spent} already: give "
            "at least that."
        )
    return kept


def _complete(run: Path, settings: TrainConfig, kept: Kept, display: Display) -> Tally:
    """Writes the missing files of a run whose budget is spent, and trains nothing."""
    current = _is_summed_up(run, kept.update)
    if not current:
        _open_run(run, settings, kept)
        with Checkpoints(run, settings.run.keep_checkpoints) as checkpoints:
            checkpoints.save(kept.leaves, kept.update, kept.logs, rate_scale=kept.rate_scale)
    _write_policies(run, settings, kept.leaves, kept.update, only_missing=current)
    steps = words.count(
        kept.update * settings.arenas * settings.algo.rollout_length, "arena control step"
    )
    for sentence in kept.skipped:
        display.say(f"{sentence}: it was passed over.")
    display.say(
        f"nothing left to train: {settings.resume} has spent its budget of {steps} "
        f"({words.count(kept.update, 'update')}); for more, give a larger budget"
    )
    tally = begin_tally(settings, kept.update, 0.0, Path(settings.resume or run), kept)
    if not current:
        with working("building the arenas"):
            program, *_ = _load(settings)
        _write_summary(run, program, tally)
    return tally


def _is_summed_up(run: Path, update: int) -> bool:
    """Returns whether the summary says that the budget was spent at this update.

    The summary is the last file that a run writes. If the summary is current, the other files are
    current too.
    """
    try:
        found = json.loads((run / directory.SUMMARY).read_text())
        return found["budget_spent"] is True and found["updates"] == update
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _load(settings: TrainConfig) -> tuple[Built, Schedule, Any, TrainState]:
    """Builds the program, the curriculum's numbers, the init function and the state's shapes."""
    program, schedule = programs.load(settings, by_robot=settings.run.episodes)
    init = jax.jit(mesh.init(program))  # traced once, both for the shapes and for the state
    template = init.eval_shape(schedule)
    memory.check_state(settings, mesh.bytes_each(settings, template), memory.limit())
    return program, schedule, init, template


def begin(settings: TrainConfig) -> tuple[Built, Schedule, TrainState]:
    """Builds a new run: its program, its curriculum's numbers and its first state.

    Args:
      settings: the config.

    Raises:
      ConfigError: if the config cannot be run.
    """
    program, schedule, init, template = _load(settings)
    source = warm_start.read(settings)
    state, _ = _first_state(program, schedule, init, template, source, None)
    return program, schedule, state


def _first_state(
    program: Built,
    schedule: Schedule,
    init: Callable[[Schedule], TrainState],
    template: TrainState,
    source: Kept | None,
    kept: Kept | None,
) -> tuple[TrainState, list[str]]:
    """Makes the first state, from the seed or from the checkpoint of the resumed run.

    A start from the seed takes the networks and normalisers of `source`, if `source` is given.

    Returns:
      The state, and a sentence for each item that was skipped.
    """
    settings = program.config
    if kept is None:
        state = init(schedule)
        if source is None:
            return state, []
        return warm_start.carry(source, state, settings), source.skipped
    return mesh.put(program, checkpoint.from_leaves(kept.leaves, template)), kept.skipped


def find_run(settings: TrainConfig) -> Path:
    """Chooses a run directory that is writable and empty, and makes it if it was not named.

    Raises:
      ConfigError: if there is no such directory, or if a library that the config needs is missing.
    """
    weights_and_biases.check(settings)
    every = seeds.numbers(settings)
    seed = f"seed{every[0]}" if len(every) == 1 else f"seeds{every[0]}-{every[-1]}"
    name = f"{datetime.now():%Y%m%d-%H%M%S}-{settings.stage_name}-{seed}"
    try:
        run = Path(settings.run.dir) if settings.run.dir else directory.claim(Path("runs"), name)
    except OSError as error:
        raise directory.unwritable(Path("runs") / name, error) from None
    check_free(run, settings)
    try:
        there = next(path for path in (run, *run.resolve().parents) if path.exists())
        tempfile.TemporaryFile(dir=there).close()
    except (OSError, ValueError) as error:
        raise directory.unwritable(run, error) from None
    return run


def check_free(run: Path, settings: TrainConfig) -> None:
    """Refuses a directory that is not empty, unless it holds the run that is resumed."""
    directory.check_regular(run)
    resumed = settings.resume is not None and Path(settings.resume).resolve() == run.resolve()
    if (run / directory.CONFIG).exists() and not resumed:
        raise ConfigError(
            f"run.dir is {run}, which holds a run already: give another directory, or "
            f"resume={run} to go on with it."
        )
    if not (run / directory.CONFIG).exists() and checkpoint.steps(run):
        raise ConfigError(
            f"run.dir is {run}, which holds {checkpoint.FOLDER}/ of a run that has lost its "
            f"{directory.CONFIG}: give another directory, or remove that one."
        )
    held = directory.visible(run) if not resumed else []
    if held:
        raise ConfigError(
            f"run.dir is {run}, which holds {reading.called(held[0])}: give a new or an empty "
            "directory."
        )


def _open_run(run: Path, settings: TrainConfig, kept: Kept | None) -> None:
    """Writes `config.json`, and copies the logs if a run is resumed in another directory."""
    stored = to_dict(replace(settings, resume=None))
    if settings.resume is not None:
        source = Path(settings.resume)
        stored = directory.kept_config(read_config(source), stored)
        if kept is not None:
            directory.bring(source, run, kept.logs)
    try:
        directory.write_json(run / directory.CONFIG, stored)
    except OSError as error:
        raise directory.unwritable(run, error) from None


def dry_run(settings: TrainConfig, stop: Stop, display: Display) -> int:
    """Compiles a run, prints the time and memory that it needs, and trains nothing.

    Args:
      settings: the config.
      stop: notices signals.
      display: shows the progress.

    Returns:
      The exit code.

    Raises:
      ConfigError: as `carry_out`.
      StoppedError: if a stop was requested.
    """
    weights_and_biases.check(settings)
    with working("building the arenas"):
        warm_start.read(settings)
        program, schedule, _, template = _load(settings)
    for sentence in (_opening(program), *_short_budget(settings, schedule)):
        display.say(sentence)
    with display.working("compiling"):
        stop.check()
        compiled = compile_chunk(program, schedule, template)
        stop.check()
        memory.check(settings, compiled.total_bytes, memory.limit())
    state, work = compiled.state_bytes / 2**20, compiled.work_bytes / 2**20
    display.say(
        f"compiled in {words.duration(compiled.seconds)}; memory: {state:.1f} MiB of state, "
        f"{work:.1f} MiB to work with; nothing was trained (run.dry)."
    )
    return 0


def _opening(program: Built) -> str:
    """Describes what is about to be trained, on which device, and which engine steps the robots."""
    settings, engine = program.config, program.world.physics.engine
    names = ", ".join(stage.name for stage in settings.stage)
    steps, every = settings.arenas * settings.algo.rollout_length, seeds.numbers(settings)
    how = {
        "vmap": "side by side",
        "cores": "spread over cores",
        "devices": "spread over devices",
    }[settings.seeds_by]
    several = f", seeds {every[0]} to {every[-1]} {how}" if len(every) > 1 else ""
    return (
        f"swarmjax: {settings.stage_name} ({names}), {words.count(settings.updates, 'update')} "
        f"of {words.count(steps, 'arena control step')} "
        f"({words.count(settings.arenas, 'arena')}){several} on {provenance.device()}; "
        f"{settings.robot.body} robots stepped by {engine.label}, "
        f"sim.solver={engine.solver} sim.impl={engine.impl}; {_learning(settings)}"
    )


def _learning(settings: TrainConfig) -> str:
    """Describes the number of gradient steps of a run, and its first learning rates."""
    steps = words.count(optimizer.gradient_steps(settings.algo, settings.updates), "gradient step")
    rates = optimizer.learning_rates(settings.algo, settings.updates)
    return (
        f"{steps}, learning rates {rates['actor']:.2g} (actor) and {rates['critic']:.2g} (critic)"
    )


def _own_pieces(settings: TrainConfig) -> str:
    """Lists the pieces of the extension that a run uses."""
    chosen = pieces.choose(extension.load(settings.extensions), settings.task, settings.stage)
    used = {stage.level for stage in settings.stage}
    found = [
        *(f"reward {piece.name} times {weight:g}" for piece, weight in chosen.terms),
        *(f"observation {piece.name}" for piece in chosen.observations),
        *(f"level {piece.name}" for piece in chosen.drawings if piece.name in used),
        *([] if settings.algo.network in (None, "mlp") else [f"network {settings.algo.network}"]),
    ]
    return ", ".join(found) or "nothing is used"


def _short_budget(settings: TrainConfig, schedule: Schedule) -> list[str]:
    """Warns, in at most one sentence, if the budget is too short for the stages."""
    share = settings.curriculum.budget_share
    if settings.curriculum.mode == "adaptive":
        return []
    begins, latest = curriculum.last_begins(schedule), math.ceil(share * settings.updates)
    if begins <= latest:
        return []
    when = f"begin as late as update {begins:,}" if begins < settings.updates else "never begin"
    least = words.count(int(schedule.cohort_updates), "update")
    return [
        f"the budget is short: each stage takes at least {least} (one step limit), so the last "
        f"stage, {settings.stage[-1].name}, may {when}, but curriculum.budget_share={share} asks "
        f"for update {latest:,} at the latest: give more budget, fewer arenas or fewer stages."
    ]


def _write_policies(
    run: Path, settings: TrainConfig, leaves: Leaves, update: int, *, only_missing: bool = False
) -> None:
    """Writes the policy of every seed, or only the missing ones."""
    for seed in seeds.numbers(settings):
        file = seed_path(run / POLICY, settings, seed)
        if not (only_missing and file.exists()):
            try:
                write_policy(file, leaves, settings, update, seed)
            except PolicyError as error:  # such as a full disk
                raise TrainingError(str(error)) from None


def _write_summary(run: Path, program: Built, tally: Tally) -> None:
    """Writes `summary.json`."""
    settings, every = program.config, seeds.numbers(program.config)
    engine = program.world.physics.engine
    steps = tally.update * settings.arenas * settings.algo.rollout_length
    train_s, transitions = tally.earlier_s + tally.seconds, tally.transitions
    summary = {
        "stage": settings.stage_name,
        "stages": settings.stage_names,
        "seeds": list(every),
        "updates": tally.update,
        "budget_spent": tally.update >= settings.updates,
        "arena_steps": steps,
        "transitions": [transitions[seed] for seed in every],
        "train_s": train_s,
        "compile_s": tally.compile_s,
        "arena_steps_per_s": settings.seeds * steps / train_s if train_s else None,
        "transitions_per_s": sum(transitions.values()) / train_s if train_s else None,
        "targets_reached": [tally.targets_reached[seed] for seed in every],
        "decisions": [
            [entry for entry in tally.decisions if entry["seed"] == seed] for seed in every
        ],
        "impl": engine.impl,
        "solver": engine.solver,
        "stepped_by": engine.label,
        "update_backend": program.ppo.backend,
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }
    directory.write_json(run / directory.SUMMARY, summary)
