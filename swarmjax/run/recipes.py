"""Recipes: files that hold the settings of a whole run, for `recipe=NAME`.

Recipes are made to be passed on, so they hold no code. `TrainConfig.shared` lists the keys that
they may set.
"""

from collections.abc import Sequence
from pathlib import Path

from swarmjax.config import ConfigError, Section, files, reading, show


def expand(cls: type[Section], typed: Sequence[str]) -> list[str]:
    """Replaces `recipe=NAME` by the words of the recipe. Typed words override these.

    A recipe may extend another recipe, which its key `recipe` names. The words of the extending
    recipe override those of the other.

    Args:
      cls: the command's dataclass.
      typed: `key=value` words.

    Returns:
      The words of the recipe, and then the other typed words.

    Raises:
      ConfigError: if there is no such recipe, or its file is invalid.
    """
    mine = [word for word in typed if word.startswith("recipe=")]
    chosen = files.parse(cls, mine).get("recipe")
    others = [word for word in typed if word not in mine]
    return [*_read(cls, chosen), *others] if chosen else others


def _read(cls: type[Section], choice: str, extended_by: Sequence[Path] = ()) -> list[str]:
    """Returns the words of a recipe, after those of the recipe that it extends."""
    path = files.named_path("recipes", choice, "recipe")
    chain = [*extended_by, path.resolve()]
    if chain[-1] in extended_by:
        raise ConfigError(f"{path} extends itself: remove the key `recipe` from one file.")
    settings = reading.read_yaml(path)
    base = settings.pop("recipe", None)
    words = files.shared_words(cls, settings, path)
    try:
        files.parse(cls, words)
        if not isinstance(base, str | None):
            raise ConfigError(
                f"recipe is {show(base)}: give the name of a recipe, or the path of a .yaml file."
            )
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    below = [] if base is None else _read(cls, files.beside(path.parent, base), chain)
    return [*below, *words]
