"""Writes completion scripts for bash, zsh and fish: commands, their keys, and values of keys.

A script holds all of this in a table, so that completing a word does not start Python. The script
must be written again after the keys change. A line of the table has a command, a key and its
values:

    train stage s1 s2 @file
    train run.dry true false

`@file` stands for the path of any file.
"""

import types
import typing
from importlib import resources

from swarmjax.config import ConfigError, files, section, show
from swarmjax.shell.commands import COMMANDS, settings

SHELLS = ("bash", "zsh", "fish")
_FILE = "@file"
_FOLDERS = {"suite": "suites"}  # keys whose folder in configs/ has another name


def script(shell: str) -> str:
    """Writes the completion script for a shell.

    Args:
      shell: one of `SHELLS`.

    Returns:
      The script's text, with a newline at the end.

    Raises:
      ConfigError: if it is another shell.
    """
    if shell not in SHELLS:
        raise ConfigError(f"--completion is {show(shell)}: give one of {', '.join(SHELLS)}.")
    text = resources.files("swarmjax.shell") / "templates" / f"completion.{shell}"
    commands = "\n".join(f"{name} {each.meaning}" for name, each in COMMANDS.items())
    return (
        text.read_text()
        .replace("@COMMANDS@", commands)
        .replace("@TABLE@", "\n".join(line for name in COMMANDS for line in table(name)))
    )


def table(name: str) -> list[str]:
    """Lists the keys of a command, one per line, with their values.

    Args:
      name: one of `COMMANDS`.
    """
    cls = settings(name)
    groups = {key for key in section.names(cls) if files.choices(_FOLDERS.get(key, key))}
    found = {key: choices(item.type) for key, item in section.keys(cls).items()}
    for key in groups:
        found[key] = [*files.choices(_FOLDERS.get(key, key)), _FILE]
    return [" ".join([name, key, *values]) for key, values in found.items()]


def choices(hint: object) -> list[str]:
    """Lists the values of a key.

    Args:
      hint: its type.

    Returns:
      Its values, with `@file` if the key takes text. A key that takes only numbers has no values.
    """
    found: list[str] = []
    for option in section.options(hint):
        if typing.get_origin(option) is typing.Literal:
            found += typing.get_args(option)
        elif option is bool:
            found += ["true", "false"]
        elif option is str:
            found.append(_FILE)
        elif option is types.NoneType:
            found.append("null")
    return found
