"""What a run prints: what it trains, its progress, how good the swarm is, what to do next."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from swarmjax import command, provenance, words
from swarmjax.config import show
from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import Kept
from swarmjax.run.directory import Row
from swarmjax.run.display import spread
from swarmjax.run.policy_export import POLICY, seed_path
from swarmjax.run.settings import TrainConfig
from swarmjax.training.rollout import Program


def first(
    settings: TrainConfig, run: Path, kept: Kept | None, source: Kept | None
) -> Iterator[str]:
    """Describes the stages, updates, seeds, device and folder of a run, and what it starts from."""
    names, title, seeds = settings.stage_names, settings.stage_name, settings.numbers
    stages = words.shorten(title, 40) + (f" {names[0]} to {names[-1]}" if len(names) > 1 else "")
    several = f" of seeds {seeds[0]} to {seeds[-1]}" if settings.seeds > 1 else ""
    yield (
        f"{words.shorten(stages, 60)}, {words.count(settings.updates, 'update')}{several} on "
        f"{provenance.device()}, into{words.GLUE}{run}"
    )
    if settings.extensions is not None:
        used = (f"{kind} {name}" for kind, names in settings.pieces.items() for name in names)
        yield f"from {settings.extensions}: {', '.join(used) or 'nothing is used'}"
    skipped = [] if kept is None else kept.skipped
    for sentence in skipped if source is None else source.skipped:
        yield f"{sentence}: it was passed over."
    if settings.resume is not None and kept is None:
        yield f"{settings.resume} has no checkpoint yet: the run begins from its seed."
    if source is not None:
        updates = words.count(source.update, "update")
        yield (
            f"starting with the networks and the normaliser of {settings.init_from} after {updates}"
        )


def details(program: Program[TrainConfig]) -> str:
    """Says how many arenas there are, and which engine steps the robots."""
    settings, engine = program.config, program.world.physics.engine
    return (
        f"{words.count(settings.arenas, 'arena')}; {settings.robot.body} robots stepped by "
        f"{engine.label}, sim.solver={engine.solver} sim.impl={engine.impl}"
    )


def nothing_left(settings: TrainConfig, update: int) -> str:
    """Says why a resumed run has nothing left to train, and what to give for more."""
    if update == settings.updates:
        return "nothing left to train: the budget is spent; for more, give a larger budget"
    return (
        f"nothing left to train: every seed has reached run.stop_at={show(settings.run.stop_at)}; "
        "for more, give a larger one, or run.stop_at=null"
    )


def promotions(settings: TrainConfig, decisions: Iterable[Row]) -> Iterator[str]:
    """Describes each change of stage. All other decisions are only in the log."""
    for entry in decisions:
        if "to" in entry:
            seed = f"seed {entry['seed']}, " if settings.seeds > 1 else ""
            yield (
                f"{seed}update {entry['update'] + 1}: {entry['from']} -> {entry['to']} by "
                f"{entry['why']} (targets reached: {spread([entry['targets_reached']])})"
            )


def diverged(settings: TrainConfig, row: Row, updates: int, *, broke: bool) -> str:
    """Says that a run has stopped learning: all arenas broke, or no gradient step was finite."""
    where = f" of seed {row['seed']}" if settings.seeds > 1 else ""
    what = "every arena{} broke at every step" if broke else "no gradient step{} was finite"
    return (
        f"{what.format(where)} in {words.count(updates, 'update')} up to update "
        f"{row['update'] + 1:,}: give lower algo.actor_learning_rate and "
        "algo.critic_learning_rate, or look at metrics.jsonl for what broke."
    )


def success(settings: TrainConfig, newest: Sequence[Row]) -> str:
    """Describes how good the swarm is on the last stage, by the last row of each seed."""
    by_targets = settings.curriculum.success == "targets"
    what = "targets reached" if by_targets else "all robots reached"
    column = "success_by_stage" if by_targets else "complete_by_stage"
    shares = [row[column][-1] for row in newest]
    said = f"{what} on {settings.stage_names[-1]}: {spread(shares)}"
    steps = settings.task.step_limit
    if all(share is None for share in shares):
        return (
            f"{said}: the run was too short on this stage, where a first value takes "
            f"{2 * steps * settings.arenas:,} control steps: give a larger budget or fewer arenas"
        )
    seconds = steps * settings.task.control_step
    measured = [row for row in newest if row[column][-1] is not None]
    episodes = min(row["episodes_by_stage"][-1] for row in measured)
    return (
        f"{said} within {steps} control steps ({seconds:.3g} s), over "
        f"{words.count(episodes, 'episode')}"
    )


def closing(settings: TrainConfig, run: Path, update: int, *, ended: bool) -> str:
    """Describes what to do next with a run that has done `update` updates, all of them or not."""
    code = [] if settings.extensions is None else [f"extensions={settings.extensions}"]
    if not ended:
        saved = max(checkpoint.steps(run), default=0)
        how = "saved" if saved == update else f"saved at update {saved:,}, the last sound one"
        return (
            f"stopped after update {update:,} of {settings.updates:,}, {how}; go on with: "
            f"{_command('train', f'resume={run}', *code)}"
        )
    policy = seed_path(run / POLICY, settings, settings.seed)
    what = "the policy" if settings.seeds == 1 else f"each of {settings.seeds} policies"
    why = ""
    if update < settings.updates:
        goal = f"run.stop_at={show(settings.run.stop_at)}"
        why = f" after update {update:,} of {settings.updates:,}, as every seed has reached {goal}"
    return f"done{why}; evaluate {what} with: {_command('evaluate', f'policy={policy}', *code)}"


def _command(*arguments: str) -> str:
    return command.line(*arguments).replace(" ", words.GLUE)
