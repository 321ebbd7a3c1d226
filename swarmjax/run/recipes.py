"""Recipes: files that hold the settings of a whole run, for `recipe=NAME`."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from swarmjax.config import files
from swarmjax.config.section import ConfigError, Section


def expand(cls: type[Section], typed: Sequence[str]) -> list[str]:
    """Replaces `recipe=NAME` by the words of the recipe. Typed words override them.

    Args:
      cls: the command's dataclass.
      typed: `key=value` words.

    Returns:
      The words of the recipe, and then the other typed words.

    Raises:
      ConfigError: if there is no such recipe, or its file is invalid.
    """
    others = [word for word in typed if not word.startswith("recipe=")]
    chosen = [files.choice_of(word) for word in typed if word.startswith("recipe=")]
    if not chosen or chosen[-1] in ("", "null"):
        return others
    path = files.named_path("recipes", chosen[-1], "recipe")
    found = files.read_yaml(path)
    if "recipe" in found:
        raise ConfigError(f"{path} names another recipe: remove the key recipe.")
    words = list(_words(found))
    try:
        files.split_words(cls, words)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return [*words, *others]


def _words(settings: Mapping[str, Any], where: str = "") -> Iterator[str]:
    """Yields nested settings as `key=value` words."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _words(value, f"{where}{key}.")
        else:
            yield f"{where}{key}={value if isinstance(value, str) else json.dumps(value)}"
