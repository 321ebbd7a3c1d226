"""Lists the commands of the console script."""

import importlib
from typing import NamedTuple

from swarmjax.config.section import Section


class Command(NamedTuple):
    """A command of the package. `python -m swarmjax.NAME` runs it too.

    Attributes:
      settings: module and name of the dataclass with the command's keys. Importing this module
        must not need JAX.
      meaning: the command's purpose, in one sentence.
    """

    settings: str
    meaning: str


# One line per command.
COMMANDS: dict[str, Command] = {
    "train": Command("swarmjax.run.settings:TrainConfig", "Train a swarm."),
    "probe": Command(
        "swarmjax.run.settings:ProbeConfig", "Count what an untrained swarm reaches by chance."
    ),
    "evaluate": Command("swarmjax.evaluate.config:EvaluateConfig", "Test policies in MuJoCo C."),
    "replay": Command("swarmjax.replay.config:ReplayConfig", "Show episodes on a page."),
    "report": Command("swarmjax.report.config:ReportConfig", "Draw the results of runs."),
    "export": Command(
        "swarmjax.export.config:ExportConfig", "Write a policy for ONNX, C or Webots."
    ),
    "reproduce": Command(
        "swarmjax.reproduce.config:ReproduceConfig", "Reproduce the study of the paper."
    ),
    "watch": Command("swarmjax.watch.config:WatchConfig", "Follow a run on a page."),
}


def settings(name: str) -> type[Section]:
    """Imports the dataclass with a command's keys.

    Args:
      name: one of `COMMANDS`.
    """
    module, _, cls = COMMANDS[name].settings.partition(":")
    return getattr(importlib.import_module(module), cls)
