"""Finds the stages that a choice of configs/stage/ names: one stage, a sequence or a grid."""

import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError, Section, build, files, section, show, to_dict
from swarmjax.config.reading import called
from swarmjax.task.stage_config import GridConfig, complete


def expand(stage: dict[str, Any], choice: str) -> list[dict[str, Any]]:
    """Returns all stages that a choice of the group `stage` names, as plain data.

    Args:
      stage: data of the group, from `files.compose`.
      choice: the name of its file.

    Raises:
      ConfigError: the file, its sequence or its grid is invalid, or the file does not take these
        keys.
    """
    if not _is_grid(choice):
        return _listed(stage, choice)
    grid = build(GridConfig, _grid(stage, choice), "stage.grid.")
    return [to_dict(cell) for cell in grid.stages()]


def pick_one(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Returns the stage that a choice of the group `stage` names, if it is a single one.

    Args:
      stage: data of the group, from `files.compose`.
      choice: the name of its file.

    Raises:
      ConfigError: the choice names several stages, or is invalid.
    """
    if _is_grid(choice):
        raise ConfigError(f"stage is {choice}, a grid: give one stage, as in stage=s6.")
    stages = _listed(stage, choice)
    if _is_sequence(choice):
        raise ConfigError(
            f"stage is {choice}, a curriculum: give one stage, as in stage={stages[-1]['name']}."
        )
    return stages[0]


def read_stage(choice: str) -> dict[str, Any]:
    """Reads a file of configs/stage/ that is a single stage.

    Raises:
      ConfigError: there is no file of this name, or the file names several stages.
    """
    found = files.read_choice("stage", choice)
    if {"sequence", "grid"} & found.keys():
        raise ConfigError(f"stage is {choice}, which names several stages: give single stages.")
    return _named(found, choice)


def load_levels[C: Section](
    cls: type[C], overrides: Sequence[str], stage: dict[str, Any] | None = None
) -> C:
    """Creates the settings of a command that plays the levels of one stage or of a suite.

    Args:
      cls: the command's dataclass, with `stage` and `suite`.
      overrides: `key=value` words.
      stage: plain data of the default stage; None for the stage of the command's file.

    Raises:
      ConfigError: a word is invalid, or a suite is given together with a key that the suite sets
        itself.
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
        if key.partition(".")[0] in ("stage", "shape", "episodes", "seed"):
            raise ConfigError(
                f"{key} cannot be given with suite={called(str(suite))}, which sets its own "
                f"levels: leave {key} or suite out."
            )


def _listed(stage: dict[str, Any], choice: str) -> list[dict[str, Any]]:
    """Returns the stage of a file, or the stages of its sequence."""
    if not _is_sequence(choice):
        return [_named(stage, choice)]
    names = section.convert(tuple[str, ...], stage["sequence"], "stage.sequence")
    names = typing.cast(tuple[str, ...], names)
    if not names:
        raise ConfigError("stage.sequence is []: give at least one stage.")
    _refuse_others(
        stage, choice, "sequence", f"a curriculum: choose one stage, as in stage={names[-1]}"
    )
    folder = Path(choice).parent if files.is_path(choice) else Path()
    return [_member(files.beside(folder, name)) for name in names]


def _grid(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Returns the axes of a grid."""
    _refuse_others(stage, choice, "grid", "a grid: give its axes, as in stage.grid.side=[0.7,1.0]")
    return stage["grid"]


def _is_sequence(choice: str) -> bool:
    """Returns whether a file of configs/stage/ is a sequence of other stages."""
    return "sequence" in files.read_choice("stage", choice)


def _is_grid(choice: str) -> bool:
    """Returns whether a file of configs/stage/ is a grid of stages."""
    return "grid" in files.read_choice("stage", choice)


def _refuse_others(stage: dict[str, Any], choice: str, only: str, advice: str) -> None:
    """Refuses keys of a single stage in a file that names several stages."""
    for key in stage.keys() - {only}:
        raise ConfigError(f"stage.{key} cannot be given for {choice}, {advice}.")


def _member(name: str) -> dict[str, Any]:
    """Reads one stage of a curriculum."""
    found = files.read_choice("stage", name, "stage.sequence")
    for key, what in (("sequence", "a curriculum itself"), ("grid", "a grid")):
        if key in found:
            raise ConfigError(f"stage.sequence names {name}, {what}: give single stages.")
    return _named(found, name)


def name_of(choice: str) -> str:
    """Returns the name of a choice of the group `stage`; a path has the name of its file."""
    return Path(choice).stem if files.is_path(choice) else choice


def _named(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Returns the stage named after its file, and refuses any other name."""
    name = name_of(choice)
    found = stage.get("name", name)
    if found != name:
        raise ConfigError(f"stage.name is {show(found)} in {name}.yaml: give the file's name.")
    return complete({"name": name, **stage})
