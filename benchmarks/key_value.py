"""Parses a benchmark's own arguments on a command line that it shares with `swarmjax.train`."""

from collections.abc import Sequence
from typing import Any

from swarmjax.config import ConfigError, Section, build, section, show
from swarmjax.config.section import keys


def load(cls: type[Section], words: Sequence[str]) -> Any:
    """Makes a config from `key=value` arguments; commas separate the values of a list.

    Args:
      cls: class of the config.
      words: `key=value` arguments of the command line.

    Returns:
      An instance of `cls`.

    Raises:
      ConfigError: if an argument is invalid.
    """
    lists = {name for name, item in keys(cls).items() if "tuple" in str(item.type)}
    given = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            raise ConfigError(f"{show(word)} is not a setting: give key=value.")
        given[key] = value.split(",") if key in lists else value
    return build(cls, given)


def parse(cls: type[Section], words: Sequence[str]) -> tuple[Any, list[str]]:
    """Makes a config from the arguments whose keys it has, and returns the other arguments too.

    Args:
      cls: class of the config.
      words: `key=value` arguments of the command line.

    Returns:
      An instance of `cls`, and the other arguments.

    Raises:
      ConfigError: if an argument with a key of `cls` is invalid.
    """
    known = section.names(cls)
    mine = [word for word in words if word.partition("=")[0] in known]
    return load(cls, mine), [word for word in words if word not in mine]
