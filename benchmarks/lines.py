"""Reads the words of a benchmark, and reads and writes its results, which are JSON lines."""

import json
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from swarmjax import provenance
from swarmjax.config import ConfigError, Section, build, files, section
from swarmjax.config.section import keys

Line = dict[str, Any]


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
    given = [
        f"{key}=[{value}]" if key in lists and value[:1] != "[" else f"{key}{equals}{value}"
        for key, equals, value in (word.partition("=") for word in words)
    ]
    return build(cls, files.parse(cls, given))


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


def made_with() -> Line:
    """Returns the entries of a line that give the device, versions and commit."""
    return {
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def write(lines: Iterable[Line]) -> None:
    """Prints each line as soon as it is ready."""
    for line in lines:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def read(path: Path) -> list[Line]:
    """Reads a file of lines.

    Args:
      path: path of the file; a last line that was cut off is skipped.

    Returns:
      The lines.

    Raises:
      ConfigError: if the file cannot be read, or a line is not a JSON object.
    """
    try:
        text = path.read_text(errors="replace")
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}.") from None
    found = []
    for number, line in enumerate(text.split("\n")[:-1], 1):
        try:
            found.append(dict(json.loads(line)))
        except (ValueError, TypeError):
            raise ConfigError(f"{path} in line {number} is not a JSON object: remove it.") from None
    return found


class Output:
    """A file to which lines are appended, so that a benchmark that was stopped can go on.

    Attributes:
      lines: the lines that the file has.
    """

    def __init__(self, path: Path) -> None:
        """Reads the existing lines, and removes a last line that was only partly written.

        Args:
          path: path of the file; it need not exist.

        Raises:
          ConfigError: if the file cannot be read or written, or holds something else.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            content = path.read_bytes()
        except OSError as error:
            raise ConfigError(
                f"out is {path}, which cannot be written: {error.strerror}."
            ) from None
        if content and not content.startswith(b"{"):
            raise ConfigError(f"out is {path}, which holds no JSON lines: give another file.")
        self.lines, self._path = read(path), path
        os.truncate(path, content.rfind(b"\n") + 1)

    def add(self, line: Line) -> None:
        """Appends a line to the file immediately."""
        self.lines.append(line)
        with self._path.open("a") as file:
            file.write(json.dumps(line) + "\n")
