"""Which stages a choice of configs/stage/ stands for: one, a sequence of others, or a grid."""

import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError, Section, build, files, section, show, to_dict
from swarmjax.config.reading import called
from swarmjax.task.stage_config import GridConfig, complete


def expand(stage: dict[str, Any], choice: str) -> list[dict[str, Any]]:
    """Return all stages that a choice of the group `stage` stands for, as plain data.

    Args:
        stage: what `files.compose` made of the group.
        choice: the name of its file.

    Raises:
        ConfigError: the file, its sequence or its grid is unsound, or takes no such keys.
    """
    if not _is_grid(choice):
        return _listed(stage, choice)
    grid = build(GridConfig, _grid(stage, choice), "stage.grid.")
    return [to_dict(cell) for cell in grid.stages()]


def pick_one(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Return the stage that a choice of the group `stage` stands for, if it is one alone.

    Args:
        stage: what `files.compose` made of the group.
        choice: the name of its file.

    Raises:
        ConfigError: it stands for several, or is unsound.
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
    """Read a file of configs/stage/ that is a single stage.

    Raises:
        ConfigError: there is none of this name, or it stands for several.
    """
    files.check_choice("stage", choice, "stage")
    if _is_sequence(choice) or _is_grid(choice):
        raise ConfigError(f"stage is {choice}, which stands for several: give single stages.")
    return _named(files.read_choice("stage", choice), choice)


def load_levels[C: Section](
    cls: type[C], overrides: Sequence[str], stage: dict[str, Any] | None = None
) -> C:
    """Make the settings of a command that plays levels of one stage, or of a suite instead.

    Args:
        cls: the command's dataclass, with `stage` and `suite`.
        overrides: `key=value` words.
        stage: plain data of the stage where no word names one; None: that of the command's file.

    Raises:
        ConfigError: a word is unsound, or a suite is given beside what it says itself.
    """

    def fill_in(mapping: dict[str, Any], chosen: dict[str, str]) -> dict[str, Any]:
        _check_suite_alone(cls, mapping.get("suite"), overrides)
        words = files.split_words(cls, overrides)
        if stage is None or "stage" in words:
            return mapping | {"stage": pick_one(mapping.get("stage", {}), chosen["stage"])}
        mine = {key: word for key, word in words.items() if key.startswith("stage.")}
        given = files.values(mine).get("stage", {})
        return mapping | {"stage": complete({**stage, **given})}

    return files.load(cls, overrides, fill_in)


def _check_suite_alone(cls: type[Section], suite: object, overrides: Sequence[str]) -> None:
    """Refuse what a suite's file says itself."""
    if suite is None:
        return
    for key in files.split_words(cls, overrides):
        if key.partition(".")[0] in ("stage", "shape", "episodes", "seed"):
            raise ConfigError(
                f"{key} cannot be given with suite={called(str(suite))}, which says what its "
                f"levels are: leave {key} or suite out."
            )


def _listed(stage: dict[str, Any], choice: str) -> list[dict[str, Any]]:
    """Return the stage that a file stands for, or its sequence."""
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
    return [_member(str(folder / name) if files.is_path(name) else name) for name in names]


def _grid(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Return the axes of a grid."""
    _refuse_others(stage, choice, "grid", "a grid: give its axes, as in stage.grid.side=[0.7,1.0]")
    return stage["grid"]


def _is_sequence(choice: str) -> bool:
    """Tell whether a file of configs/stage/ names a sequence of others."""
    return "sequence" in files.read_choice("stage", choice)


def _is_grid(choice: str) -> bool:
    """Tell whether a file of configs/stage/ is a grid of stages."""
    return "grid" in files.read_choice("stage", choice)


def _refuse_others(stage: dict[str, Any], choice: str, only: str, advice: str) -> None:
    """Refuse keys of a single stage where a file stands for several."""
    for key in stage.keys() - {only}:
        raise ConfigError(f"stage.{key} cannot be given for {choice}, {advice}.")


def _member(name: str) -> dict[str, Any]:
    """Read one stage of a curriculum."""
    files.check_choice("stage", name, "stage.sequence")
    if _is_sequence(name):
        raise ConfigError(f"stage.sequence names {name}, a curriculum itself: give single stages.")
    if _is_grid(name):
        raise ConfigError(f"stage.sequence names {name}, a grid: give single stages.")
    return _named(files.read_choice("stage", name), name)


def name_of(choice: str) -> str:
    """Return what a choice of the group `stage` is called: its name, or that of its file."""
    return Path(choice).stem if files.is_path(choice) else choice


def _named(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Return the stage under the name of its file, and refuse another name."""
    name = name_of(choice)
    found = stage.get("name", name)
    if found != name:
        raise ConfigError(f"stage.name is {show(found)} in {name}.yaml: give the file's name.")
    return complete({"name": name, **stage})
