"""Recipes: files that hold the settings of a whole run, for `recipe=NAME`.

Recipes are made to be passed on, so they are data: `TrainConfig.shared` lists what they may set.
"""

from collections.abc import Sequence
from pathlib import Path

from swarmjax.config import ConfigError, Section, files, reading, show


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
    words, chain = others, list[Path]()
    while chosen:
        path = files.named_path("recipes", chosen, "recipe")
        own, chosen = _read(cls, path)
        if path.resolve() in chain:
            raise ConfigError(
                f"{path} extends itself: remove the key recipe from one of the files."
            )
        chain.append(path.resolve())
        words = [*own, *words]
    return words


def _read(cls: type[Section], path: Path) -> tuple[list[str], str | None]:
    """Returns the own words of a recipe, and the choice of the recipe that it extends."""
    found = reading.read_yaml(path)
    base = found.pop("recipe", None)
    choices, values = files.read_shared(cls, found, path)
    words = files.write_words({**choices, **values})
    try:
        files.parse(cls, words)
        if not isinstance(base, str | None):
            raise ConfigError(
                f"recipe is {show(base)}: give the name of a recipe, or a file .yaml."
            )
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return words, None if base is None else files.beside(path.parent, base)
