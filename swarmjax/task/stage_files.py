"""Reads the files of configs/stage/, each of which holds one stage or a sequence of stages."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError, Section, files, show
from swarmjax.config.reading import called
from swarmjax.task.stage_config import complete


def expand(stage: dict[str, Any], choice: str) -> list[dict[str, Any]]:
    """Returns all stages that a choice of the group `stage` names, as plain data.

    Args:
      stage: data of the group, from `files.load`.
      choice: the name of its file.

    Raises:
      ConfigError: the file or its sequence is invalid, or keys are set for a sequence.
    """
    if not _is_sequence(choice):
        return [_named(stage, choice)]
    for key in sorted(stage.keys() - {"sequence", "name"}):
        raise ConfigError(
            f"stage.{key} cannot be given for {choice}, a curriculum: choose one stage, as in "
            f"stage=s6 (in a recipe: 'stage: s6', and 'stage.{key}: {show(stage[key])}' below it)."
        )
    _check_name(stage, choice)
    return _sequence(stage["sequence"], choice)


def pick_one(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Returns the stage that a choice of the group `stage` names, if it is a single one.

    Args:
      stage: data of the group, from `files.load`.
      choice: the name of its file.

    Raises:
      ConfigError: the choice names several stages, or is invalid.
    """
    if _is_sequence(choice):
        raise ConfigError(f"stage is {choice}, a curriculum: give one stage, as in stage=s6.")
    return _named(stage, choice)


def read_stage(choice: str, key: str = "stage") -> dict[str, Any]:
    """Reads a file of configs/stage/ that is a single stage.

    Args:
      choice: the name of the file.
      key: the key that names the file, for messages.

    Raises:
      ConfigError: there is no file of this name, or the file names several stages.
    """
    if _is_sequence(choice, key):
        raise ConfigError(f"{key} is {choice}, a curriculum of several stages: list single stages.")
    return _named(files.read_choice("stage", choice), choice)


def load_levels[C: Section](
    cls: type[C], overrides: Sequence[str], stage: dict[str, Any] | None = None
) -> C:
    """Creates the settings of a command that runs levels of one stage or of a suite.

    Args:
      cls: the command's dataclass, with `stage` and `suite`.
      overrides: `key=value` arguments.
      stage: plain data of the default stage; None for the stage of the command's file.

    Raises:
      ConfigError: an argument is invalid, or sets a key that the suite sets itself.
    """

    def fill_in(mapping: dict[str, Any], chosen: dict[str, str]) -> dict[str, Any]:
        _check_suite_alone(cls, mapping.get("suite"), overrides)
        words = files.parse(cls, overrides)
        if stage is None or "stage" in words:
            return mapping | {"stage": pick_one(mapping.get("stage", {}), chosen["stage"])}
        mine = {key: value for key, value in words.items() if key.startswith("stage.")}
        given = files.nest(mine).get("stage", {})
        return mapping | {"stage": complete({**stage, **given})}

    return files.load(cls, overrides, fill_in)


def _check_suite_alone(cls: type[Section], suite: object, overrides: Sequence[str]) -> None:
    """Refuses keys that the suite's file sets itself."""
    if suite is None:
        return
    for key in files.parse(cls, overrides):
        if key.partition(".")[0] in ("stage", "episodes", "seed"):
            raise ConfigError(
                f"{key} cannot be given with suite={called(str(suite))}, which sets its own "
                f"levels: leave {key} or suite out."
            )


def _is_sequence(choice: str, key: str = "stage") -> bool:
    """Returns whether a file of configs/stage/ names several stages."""
    return "sequence" in files.read_choice("stage", choice, key)


def _sequence(stages: Any, choice: str) -> list[dict[str, Any]]:
    """Returns the stages of a sequence: each entry is a stage, or the name of its file."""
    if not isinstance(stages, Sequence) or isinstance(stages, str):
        raise ConfigError(f"stage.sequence is {show(stages)}: give a list, as in [s1,s2].")
    if not stages:
        raise ConfigError("stage.sequence is []: give at least one stage.")
    folder = Path(choice).parent if files.is_path(choice) else Path()
    return [
        complete(dict(each))
        if isinstance(each, Mapping)
        else read_stage(files.beside(folder, str(each)), "stage.sequence")
        for each in stages
    ]


def name_of(choice: str) -> str:
    """Returns the name of a choice of the group `stage`; a path has the name of its file."""
    return Path(choice).stem if files.is_path(choice) else choice


def _named(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Returns the stage named after its file, and refuses any other name."""
    _check_name(stage, choice)
    return complete({"name": name_of(choice), **stage})


def _check_name(stage: dict[str, Any], choice: str) -> None:
    """Refuses a stage whose name is not that of its file."""
    name = name_of(choice)
    given = stage.get("name", name)
    if given != name:
        raise ConfigError(f"stage.name is {show(given)} in {name}.yaml: give '{name}'.")
