"""Recipes: files that hold the settings of a whole run, for `recipe=NAME`.

Recipes are made to be passed on, so they are data: `TrainConfig.shared` lists what they may set.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError, Section, files, show


def expand(cls: type[Section], typed: Sequence[str]) -> list[str]:
    """Replaces `recipe=NAME` by the words of the recipe. Typed words override them.

    A recipe may extend another one, which the key `recipe` names. Its own words override the
    other's.

    Args:
      cls: the command's dataclass.
      typed: `key=value` words.

    Returns:
      The words of the recipe, and then the other typed words.

    Raises:
      ConfigError: if there is no such recipe, or its file is invalid.
    """
    others = [word for word in typed if not word.startswith("recipe=")]
    chosen = files.parse(cls, [word for word in typed if word.startswith("recipe=")]).get("recipe")
    if not chosen:
        return others
    path, chain = files.named_path("recipes", chosen, "recipe"), list[Path]()
    words = others
    while path is not None:
        own, base = _read(cls, path)
        words = [*own, *words]
        chain.append(path.resolve())
        if base is not None and base.resolve() in chain:
            raise ConfigError(
                f"{path} extends {base}, which extends it in turn: remove the key recipe from one "
                "of them."
            )
        path = base
    return words


def _read(cls: type[Section], path: Path) -> tuple[list[str], Path | None]:
    """Returns the own words of a recipe, and the file of the recipe that it extends."""
    found = files.read_yaml(path)
    base = found.pop("recipe", None)
    files.check_shared(cls, found, path)
    choices, values = files.of_file(found, path.parent)
    words = [*_words(choices), *_words(values)]
    try:
        files.parse(cls, words)
        return words, _base(path, base)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _base(path: Path, choice: Any) -> Path | None:
    """Returns the file that the key `recipe` of a file names; None if it names none."""
    if choice is None:
        return None
    if not isinstance(choice, str):
        raise ConfigError(f"recipe is {show(choice)}: give the name of a recipe, or a file .yaml.")
    base = files.named_path("recipes", files.beside(path.parent, choice), "recipe")
    if not base.is_file():  # also a loop of links
        raise ConfigError(f"recipe is {show(choice)}, and there is no such file.")
    return base


def _words(settings: Mapping[str, Any], where: str = "") -> Iterator[str]:
    """Yields nested settings as `key=value` words."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _words(value, f"{where}{key}.")
        else:
            yield f"{where}{key}={files.write(value)}"
