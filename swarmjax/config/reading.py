"""Reads YAML and JSON files that users give, and does not trust them.

Only regular files are read, because reading a pipe could block forever. Whole files have a maximum
size, and so has each line of a longer file. YAML is loaded only after its values and its depth have
been counted.
"""

import contextlib
import functools
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

from swarmjax.config.values import ConfigError, show

MOST_TYPED = 2**20  # bytes in a file that a person writes; files of configs/ are 1000 times smaller
MOST_MADE = 2**24  # bytes in a file that the project writes, such as a run's config
_MOST_LINE = 2**24  # bytes in one line of a file with one object per line
# The most values that a YAML file may have. The largest file of configs/ has under 200.
MOST_VALUES = 10_000
_MOST_DEPTH = 32  # how deep lists and mappings may be nested
_TOO_DEEP = f"lists or mappings are nested more than {_MOST_DEPTH} deep."


def read_bytes(path: Path, most: int = MOST_TYPED) -> bytes:
    """Reads a whole file.

    Args:
      path: the file.
      most: maximum size, bytes.

    Raises:
      ConfigError: if the file is missing, not a regular file, too large or unreadable.
    """
    with _explained(path), _open(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ConfigError(f"{called(path)} cannot be read: it has more than {most} bytes.")
    return content


def _open(path: Path) -> BinaryIO:
    """Opens a regular file, and refuses pipes and devices, on which reading could block."""
    if path.exists() and not path.is_file():
        raise OSError(0, "it is not a regular file")
    return path.open("rb")


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turns errors while reading a file into one sentence."""
    try:
        yield
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{called(path)} cannot be read: {reason}.") from None


def read_text(path: Path, most: int = MOST_TYPED) -> str:
    """Reads a whole file of UTF-8 text.

    Args:
      path: the file.
      most: maximum size, bytes.

    Raises:
      ConfigError: as in `read_bytes`, or if the file is not UTF-8 text.
    """
    try:
        return read_bytes(path, most).decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{called(path)} cannot be read: it is not UTF-8 text.") from None


def called(path: Path | str) -> str:
    """Formats a path for a message, on one line and not too long."""
    text = str(path)
    return text if text.isprintable() and len(text) <= 300 else show(text)


# JSON


def read_json(path: Path) -> Any:
    """Reads a file with one JSON value.

    Args:
      path: the file, at most `MOST_MADE` bytes.

    Raises:
      ConfigError: as in `read_text`, or if the file is not JSON.
    """
    return parse_json(read_text(path, MOST_MADE), called(path))


def parse_json(text: str, where: str) -> Any:
    """Parses a JSON text.

    Args:
      text: the whole text.
      where: name of the text in messages.

    Raises:
      ConfigError: if the text is not JSON, is nested too deeply, or holds a number with too many
        digits.
    """
    try:
        found = json.loads(text)
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"{where} cannot be read as JSON: {_first_line(error)}.") from None
    if _depth(found) > _MOST_DEPTH:  # Python could not write or compare such a value later
        raise ConfigError(f"{where} cannot be read: {_TOO_DEEP}")
    return found


def _depth(value: object, above: int = 0) -> int:
    """Returns how deep lists and objects are nested. Counting stops just beyond the maximum."""
    inner = list(value.values()) if isinstance(value, dict) else value
    if not isinstance(inner, list) or above > _MOST_DEPTH:
        return above
    return max((_depth(each, above + 1) for each in inner), default=above + 1)


def read_lines(path: Path) -> Iterator[bytes]:
    """Yields the lines of a file of any length, with their line ends.

    Args:
      path: the file.

    Raises:
      ConfigError: if the file is missing, not a regular file or unreadable, or if a line is too
        long.
    """
    with _explained(path), _open(path) as file:
        while line := file.readline(_MOST_LINE + 1):
            if len(line) > _MOST_LINE:
                raise ConfigError(f"{called(path)} has a line of more than {_MOST_LINE} bytes.")
            yield line


# YAML


def read_yaml(path: Path) -> dict[str, Any]:
    """Reads a YAML file of keys and values. An empty file gives an empty dictionary.

    Args:
      path: the file.

    Raises:
      ConfigError: as in `read_text` and `parse_yaml`, or if the file does not hold keys and values.
    """
    content = parse_yaml(read_text(path), f"{called(path)} cannot be read: ")
    if not isinstance(content, dict | None):
        raise ConfigError(f"{called(path)} must hold keys: write `key: value` on each line.")
    return content or {}


def parse_yaml(text: str, where: str) -> Any:
    """Parses a YAML text with the scalars of YAML 1.2: text, numbers, true, false and null.

    Args:
      text: the whole text.
      where: the beginning of messages about the text.

    Returns:
      The content as plain data. `1e6` is a number; a date and `yes` are text.

    Raises:
      ConfigError: if the text is not YAML, has a tag, expands to too many values, or has a key that
        is not text.
    """
    import yaml

    loader = _loader()
    try:
        _measure(yaml.parse(text, loader), where)
        return yaml.load(text, loader)
    except ConfigError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ConfigError(f"{where}{error.problem}{place}.") from None
    except (yaml.YAMLError, ValueError) as error:  # letters, keys and numbers that are not allowed
        raise ConfigError(f"{where}{_first_line(error)}.") from None


def _measure(events: Iterable[Any], where: str) -> None:
    """Refuses a YAML text that has tags or aliases, too many values, or is nested too deeply."""
    import yaml

    depth = count = 0
    for event in events:
        if getattr(event, "tag", None) is not None:
            raise ConfigError(f"{where}remove the YAML tag {show(event.tag)}.")
        if isinstance(event, yaml.AliasEvent):  # a few lines of aliases may stand for billions
            raise ConfigError(f"{where}replace the YAML alias *{event.anchor} with its value.")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        count += isinstance(event, yaml.CollectionStartEvent | yaml.ScalarEvent)
        if depth > _MOST_DEPTH:
            raise ConfigError(f"{where}{_TOO_DEEP}")
        if count > MOST_VALUES:
            raise ConfigError(f"{where}it has more than {MOST_VALUES} values.")


# The decimal scalars of YAML 1.2's core schema (yaml.org/spec/1.2.2, section 10.3.2), by PyYAML's
# name for them. Anything else is text.
_SCALARS = {
    "null": r"null|Null|NULL|~|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?\d+",
    "float": r"[-+]?(\.\d+|\d+(\.\d*)?)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
}


@functools.cache
def _loader() -> Any:
    """Makes the YAML loader, in C if available."""
    import yaml

    base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

    class Loader(base):
        yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            found = dict[str, Any]()
            for key, value in node.value:
                name = self.construct_object(key, deep=True)
                if not isinstance(name, str):
                    raise ValueError(f"key {show(name)} is not text")
                if name in found:
                    raise ValueError(f"key {show(name)} is given twice")
                found[name] = self.construct_object(value, deep=deep)
            return found

    for name, pattern in _SCALARS.items():
        tag = f"tag:yaml.org,2002:{name}"
        Loader.add_implicit_resolver(tag, re.compile(f"^(?:{pattern})$", re.ASCII), None)
    # PyYAML would read 010 as 8, as in YAML 1.1.
    Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
    return Loader


def _first_line(error: Exception) -> str:
    """Shortens an error to a part of a sentence."""
    text = " ".join(str(error).split())
    return (text if len(text) <= 200 else f"{text[:197]}...").rstrip(".")
