"""A run, from its config to its finished directory."""

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
from swarmjax.config import ConfigError, to_dict
from swarmjax.curriculum import engine as curriculum
from swarmjax.curriculum.engine import Schedule
from swarmjax.policy import PolicyError
from swarmjax.ppo import optimizer
from swarmjax.run import checkpoint, directory, hosts, memory, warm_start, weights_and_biases
from swarmjax.run.checkpoint import Checkpoints, Kept, Leaves
from swarmjax.run.display import Display, working
from swarmjax.run.errors import DivergedError, TrainingError
from swarmjax.run.policy_export import POLICY, seed_path, write_policy
from swarmjax.run.settings import TrainConfig, from_stored, read_config
from swarmjax.run.signals import Stop
from swarmjax.run.trainer import Built, Tally, begin_tally, compile_chunk, prepare, train
from swarmjax.run.warm_start import Source
from swarmjax.task import pieces
from swarmjax.task.config import describe
from swarmjax.training import mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState

_LOWERED = 0.1  # what the learning rates of a run that diverged are multiplied by
_GIVE_UP = (
    "It had gone back once already: give lower algo.actor_learning_rate and "
    "algo.critic_learning_rate, or look at metrics.jsonl for what broke."
)
_PRICE = "learners/price/"  # of checkpoints written while algo.contact_limit was a key


def carry_out(settings: TrainConfig, run: Path, stop: Stop, display: Display) -> Tally:
    """Trains as a config says, and writes what a run directory holds.

    Args:
      settings: the config; with `resume` it goes on. A run whose budget is spent is not compiled:
        what its directory lacks is written.
      run: the run directory, in which there is no other run.
      stop: notices signals.
      display: shows the run.

    Returns:
      What came of the run.

    Raises:
      ConfigError: if it cannot begin as the config says, or needs more memory than there is, or
        another process writes the directory.
      CheckpointError: if what it goes on with is damaged.
      TrainingError: if the run diverges again after it went back once, or its directory cannot be
        written any more.
      StoppedError: if somebody asked to stop before there was anything to save.
    """
    with directory.locked(run):
        if hosts.is_first():  # the folder of the others links to checkpoints of the first
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
    source: Source | None,
    kept: Kept | None,
) -> Tally:
    """Trains from a checkpoint, or from the seed and what `source` had learned."""
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
    program: Built, run: Path, source: Source | None, kept: Kept | None, skipped: list[str]
) -> Iterator[str]:
    """Says what is trained, by what, and what it begins with."""
    settings = program.config
    yield f"{_opening(program)}; into {run}"
    if settings.extensions is not None:
        yield f"from {settings.extensions}: {_own_pieces(settings)}"
    for sentence in skipped:
        yield f"{sentence}: it was passed over."
    for sentence in [] if kept is None else kept.notes:
        yield f"{sentence}."
    if kept is not None and not kept.has_arenas:
        yield (
            "the checkpoint holds no arenas (run.checkpoint_arenas=false): they are drawn again, "
            "and the curriculum begins to measure its stages with them."
        )
    if settings.resume is not None and kept is None:
        yield f"{settings.resume} has no checkpoint yet: it begins from its seed."
    if kept is not None and settings.resume is not None:
        yield from _dealt_again(settings)
    if source is not None:
        updates = words.count(source.update, "update")
        as_there = describe(settings.robot, settings.task, settings.realism)
        yield (
            f"starting with what {source.run} had learned after {updates}; robot, task, realism "
            f"and network as there, unless told otherwise: {as_there}"
        )


def _dealt_again(settings: TrainConfig) -> Iterator[str]:
    """Says that a run goes on with other random streams than it had."""
    before = from_stored(read_config(Path(settings.resume or ""))).stream_count
    now = settings.stream_count
    if now != before:
        yield (
            f"random numbers come in {words.count(now, 'stream')} from here on, and not in "
            f"{before}: what was learned is kept, and other levels are drawn than would have been."
        )


def _read_kept(settings: TrainConfig) -> Kept | None:
    """Reads the newest sound checkpoint of the run that is resumed, if it has any."""
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
    """Writes what the directory of a run lacks whose budget is spent; trains nothing."""
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
    """Tells whether a summary says that the budget was spent with this update.

    It is the last file that is written, so the others are then as new.
    """
    try:
        found = json.loads((run / directory.SUMMARY).read_text())
        return found["budget_spent"] is True and found["updates"] == update
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _load(settings: TrainConfig) -> tuple[Built, Schedule, Any, TrainState]:
    """Builds the program, the curriculum's numbers, what starts a run, and its state's shapes."""
    program, schedule = programs.load(settings, by_robot=settings.run.episodes)
    init = jax.jit(mesh.init(program))  # traced once, for the shapes and for the state
    template = init.eval_shape(schedule)
    memory.check_buffer(settings, seeds.size(template.curriculum.levels), memory.limit())
    memory.check_state(settings, mesh.bytes_each(settings, template), memory.limit())
    return program, schedule, init, template


def begin(settings: TrainConfig) -> tuple[Built, Schedule, TrainState]:
    """Builds a run that begins: its program, its curriculum's numbers and its first state.

    Args:
      settings: the config.

    Raises:
      ConfigError: if it cannot begin as the config says.
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
    source: Source | None,
    kept: Kept | None,
) -> tuple[TrainState, list[str]]:
    """Starts from the seed, or from the checkpoint of the run that is resumed.

    A start from the seed takes the networks and normalisers of `source`, if there is one.
    """
    settings = program.config
    if kept is None:
        state = init(schedule)
        if source is None:
            return state, []
        return warm_start.carry(source, state, settings), source.skipped
    skipped = kept.skipped
    if any(name.startswith(_PRICE) for name in kept.leaves):
        skipped = [*skipped, f"a price on contacts (algo.contact_limit) in {settings.resume}"]
    if kept.has_arenas:
        return mesh.put(program, checkpoint.from_leaves(kept.leaves, template)), skipped
    without: Any = replace(template, arenas=None)
    state = mesh.put(program, checkpoint.from_leaves(kept.leaves, without))
    return mesh.draw_arenas(program, schedule, state), skipped


def find_run(settings: TrainConfig) -> Path:
    """Finds a run directory that can be written and holds no other run; writes nothing.

    Raises:
      ConfigError: if there is none, or a library that the run asks for is missing.
    """
    weights_and_biases.check(settings)
    every = seeds.numbers(settings)
    seed = f"seed{every[0]}" if len(every) == 1 else f"seeds{every[0]}-{every[-1]}"
    name = f"{datetime.now():%Y%m%d-%H%M%S}-{settings.stage_name}-{seed}"
    run = Path(settings.run.dir) if settings.run.dir else Path("runs") / name
    check_free(run, settings)
    try:
        there = next(path for path in (run, *run.resolve().parents) if path.exists())
        tempfile.TemporaryFile(dir=there).close()
    except (OSError, ValueError) as error:
        raise directory.unwritable(run, error) from None
    return run


def check_free(run: Path, settings: TrainConfig) -> None:
    """Refuses a directory that holds a run, unless it is the one that goes on."""
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


def _open_run(run: Path, settings: TrainConfig, kept: Kept | None) -> None:
    """Writes `config.json`, and brings the logs of a run that goes on in another directory."""
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
    """Compiles, says what it took and what a run needs, and stops.

    Args:
      settings: the config.
      stop: notices signals.
      display: shows what is done.

    Returns:
      The exit code.

    Raises:
      ConfigError: as `carry_out`.
      StoppedError: if somebody asked to stop.
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
    """Says what is about to be trained, where, and what steps the robots."""
    settings, engine = program.config, program.world.physics.engine
    names = ", ".join(stage.name for stage in settings.stage)
    steps, every = settings.arenas * settings.algo.rollout_length, seeds.numbers(settings)
    how = {
        "vmap": "side by side",
        "map": "in turn",
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
    """Says how many gradient steps a run takes, and with which learning rates it begins."""
    steps = words.count(optimizer.gradient_steps(settings.algo, settings.updates), "gradient step")
    rates = optimizer.learning_rates(settings.algo, settings.updates)
    return (
        f"{steps}, learning rates {rates['actor']:.2g} (actor) and {rates['critic']:.2g} (critic)"
    )


def _own_pieces(settings: TrainConfig) -> str:
    """Names the pieces of an extension that are used."""
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
    """Says where stages need more of the budget than they are to have, in no or one sentence."""
    share = settings.curriculum.budget_share
    if share is None or settings.curriculum.prerequisites:
        return []
    begins, latest = curriculum.last_begins(schedule), math.ceil(share * settings.updates)
    if begins <= latest:
        return []
    when = f"begin as late as update {begins:,}" if begins < settings.updates else "never begin"
    least = words.count(int(schedule.cohort_updates), "update")
    return [
        f"the budget is short: a stage takes at least {least} (one step limit), so that "
        f"{settings.stage[-1].name}, the last, may {when}, where "
        f"curriculum.budget_share={share} asks for {latest:,} at the latest: give more budget, "
        "fewer arenas or fewer stages."
    ]


def _write_policies(
    run: Path, settings: TrainConfig, leaves: Leaves, update: int, *, only_missing: bool = False
) -> None:
    """Writes the policy of every seed, or of those alone that have none."""
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
        "stages": [stage.name for stage in settings.stage],
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
        "update_backend": program.backend,
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }
    directory.write_json(run / directory.SUMMARY, summary)
