"""Replays a level with the newest policy of a run, in MuJoCo's C engine.

The weights come from the newest sound checkpoint. No code from the run directory is executed. A
policy that needs an extension is shown only if the user names the extension's file.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import Progress

from swarmjax import command, policy_file, words
from swarmjax.config import to_dict
from swarmjax.evaluate import trained_settings
from swarmjax.evaluate.trials import Entrant
from swarmjax.replay import page as replay_page
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.episodes import replay
from swarmjax.report import rows
from swarmjax.report.rows import History
from swarmjax.run.load_settings import settle
from swarmjax.run.settings import TrainConfig
from swarmjax.task.stage_config import StageConfig
from swarmjax.watch.config import WatchConfig


def record(settings: WatchConfig, history: History | None) -> tuple[str, str]:
    """Replays a level with the newest policy.

    Args:
      settings: settings of the page.
      history: the run's logged results; None before the first update.

    Returns:
      A sentence that describes the replay, and its HTML page.

    Raises:
      ConfigError: if the policy cannot be replayed with these settings.
      CheckpointError: if no checkpoint is sound.
      PolicyError: if the policy is invalid.
    """
    from swarmjax.run import checkpoint  # imports JAX, which takes seconds
    from swarmjax.run.policy_export import write_policy

    run = Path(settings.run)
    trained = settle(replace(rows.read_config(run), extensions=settings.extensions))
    seed, stage = trained.numbers[0], _stage(trained, history)
    leaves, update, *_ = checkpoint.find(run)
    name = f"update-{update}.npz"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        write_policy(file, leaves, trained, update, seed)
        entrant = Entrant(name, policy_file.read(file, settings.extensions))
    asked = [f"steps={trained.task.step_limit}"]
    shown, _ = trained_settings.load(ReplayConfig, asked, [entrant], to_dict(stage))
    shown = replace(shown, extensions=settings.extensions)
    episodes = replay(shown, [entrant], Progress(disable=True))
    made_by = command.line("watch", f"run={run}")
    page = replay_page.page(shown, [entrant.policy], episodes, made_by)
    several = f" of seed {seed}" if trained.seeds > 1 else ""
    sentence = (
        f"Level 0 of stage {stage.name}, by the policy{several} after "
        f"{words.count(update, 'update')}."
    )
    return sentence, page


def _stage(trained: TrainConfig, history: History | None) -> StageConfig:
    """Chooses the stage that most arenas are on."""
    if history is None:
        return trained.stage[0]
    return trained.stage[int(np.argmax(history.mix[:, -1].mean(axis=0)))]
