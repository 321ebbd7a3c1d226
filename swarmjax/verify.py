"""`python -m swarmjax.verify run=DIR`: trains a run's first updates again and compares digests.

It exits with 0 if every state equals the saved one bit for bit, and with 1 otherwise.

Examples:
  # train it again up to its first checkpoint, and compare digests
  python -m swarmjax.verify run=runs/first
  # up to update 500
  python -m swarmjax.verify run=runs/first updates=500
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from swarmjax import command, words
from swarmjax.config import ConfigError, Section, about, files, setting, show
from swarmjax.config.section import MAX_COUNT
from swarmjax.exit_codes import FAILED
from swarmjax.run import directory
from swarmjax.run.errors import CheckpointError
from swarmjax.run.load_settings import from_stored, read_config, settle
from swarmjax.run.settings import TrainConfig


@dataclass(frozen=True, kw_only=True)
class VerifyConfig(Section):
    """Which run to train again, and for how many updates."""

    command: ClassVar[str] = "verify"

    run: str = field(metadata=about("run directory"))
    updates: int | None = setting(
        None, "train at most this many updates; null: to the first checkpoint", 1, MAX_COUNT
    )
    extensions: str | None = setting(
        None, "Python file with the pieces that the run needs; it will be executed"
    )


def load_digests(settings: VerifyConfig, trained: TrainConfig) -> dict[int, str]:
    """Reads the digests that can be compared.

    Args:
      settings: settings of this command.
      trained: config of the run.

    Returns:
      Digests of the state by update, in ascending order.

    Raises:
      ConfigError: if the run has saved no digest that can be compared.
      CheckpointError: if its log is damaged.
    """
    log = Path(settings.run) / directory.SAVED
    # Learning rates fall to 0 over the budget, and each stream has its own random numbers.
    own = {"budget": trained.budget, "streams": trained.stream_count}
    try:
        digests = {
            row["update"]: row["digest"]
            for row in directory.read_rows(log, None)
            if row["update"] > 0 and all(row.get(key, own[key]) == own[key] for key in own)
        }
    except (KeyError, TypeError):
        raise CheckpointError(f"{log} is damaged: put the file back.") from None
    most = settings.updates or min(digests, default=0)
    chosen = {update: digests[update] for update in sorted(digests) if update <= most}
    if not chosen:
        raise ConfigError(
            f"run is {settings.run}, which has no digests in {directory.SAVED} that training from "
            f"the beginning could reproduce with updates={show(settings.updates)}: give more "
            "updates, or a run that has saved a checkpoint with the budget and random streams of "
            "its config.json."
        )
    return chosen


def replay(trained: TrainConfig, updates: Sequence[int]) -> dict[int, str]:
    """Trains a run from its beginning.

    Args:
      trained: the run's config.
      updates: updates after which to compute a digest, ascending.

    Returns:
      Digests of the state by update.
    """
    import numpy as np

    from swarmjax.policy import digest
    from swarmjax.run import checkpoint
    from swarmjax.run.run import Run

    run, found, done = Run(trained), {}, 0
    run.load()
    run.compile()
    state = run.state
    for update in updates:
        while done < update:
            n = min(update - done, run.program.rows)
            state, _ = run.compiled.call(run.schedule, state, np.int32(n))
            done += n
        found[update] = digest(checkpoint.to_leaves(state))
    return found


def main(arguments: Sequence[str]) -> int:
    """Runs the command and returns its exit code."""
    settings: VerifyConfig = files.load(VerifyConfig, arguments)
    trained = from_stored(read_config(Path(settings.run)), "stored ")
    trained = replace(trained, extensions=settings.extensions)
    saved = load_digests(settings, trained)
    found = replay(settle(trained), list(saved))
    differing = [update for update in saved if found[update] != saved[update]]
    if differing:
        sys.stdout.write(
            f"{settings.run} differs from update {differing[0]} on: another version, device or "
            "config trained it, or its device does not compute the same bits twice.\n"
        )
        return FAILED
    what = words.count(len(saved), "checkpoint")
    sys.stdout.write(
        f"{settings.run} was reproduced bit for bit, up to update {max(saved):,} ({what} "
        "compared).\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(command.run("verify", main, VerifyConfig, (CheckpointError,)))
