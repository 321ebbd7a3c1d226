"""What bash, zsh and fish complete behind `swarmjax`: commands, their keys, and choices of a key.

A script holds all of it in a table, so that completing a word starts no Python; it is written again
where the keys have changed. A line of the table is a command, a key and the choices of its value:

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
_FOLDERS = {"suite": "suites"}  # folders of configs/ that hold the choices of a key of another name


def script(shell: str) -> str:
    """Write the script that a shell reads.

    Args:
      shell: one of `SHELLS`.

    Returns:
      Its text, with a newline at the end.

    Raises:
      ConfigError: it is another shell.
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
    """List the keys of a command, each on a line with its choices.

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
    """List what a key may be.

    Args:
      hint: its type.

    Returns:
      Its words; `@file` among them where text is taken, and none where only numbers are.
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
