"""Composes the files of configs/ and the words of a command line into plain data.

The words are `key=value`. The files, and the values in the words, are YAML 1.2. Nothing in them is
evaluated: `${...}` is plain text. `section.build` turns the composed data into settings.
"""

import difflib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import reading, section, values
from swarmjax.config.section import Section
from swarmjax.config.values import ConfigError, check_text, show

_PACKAGE = Path(__file__).resolve().parents[1]
_MOST_KEY = 200  # letters of a key on the command line

# For these groups, the message about an unknown choice says that the path of a file is allowed too.
_OWN_FILES = ("stage", "robot", "realism", "recipes")
# Files of this group may set keys of any section, not only of their own; `algo=paper` does.
_WHOLE = "algo"

# A function that takes the composed data and the choice of each group, and returns the keys and
# values to check.
Complete = Callable[[dict[str, Any], dict[str, str]], dict[str, Any]]


def load[C: Section](cls: type[C], overrides: Sequence[str], complete: Complete | None = None) -> C:
    """Makes a command's settings from its files and its `key=value` words. Words override files.

    Args:
      cls: the command's dataclass. Its `command` names the file in configs/.
      overrides: the `key=value` words.
      complete: a function that takes the composed data and the choice of each group, and returns
        the keys and values to check. With None, the composed data are checked as they are.

    Returns:
      The settings.

    Raises:
      ConfigError: if a word, a choice, a file or a value is invalid.
    """
    first, typed = defaults(cls.command), parse(cls, overrides)
    algo, whole = _read_whole(cls, (first | typed).get(_WHOLE))
    flat = whole | typed
    chosen = first | {key: value for key, value in flat.items() if choices(key)}
    by_group = {group: read_choice(group, choice) for group, choice in chosen.items()} | algo
    mapping = merge(by_group, nest({k: value for k, value in flat.items() if k not in chosen}))
    return section.build(cls, complete(mapping, chosen) if complete else mapping)


def _read_whole(cls: type[Section], choice: str | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads a file of the group `algo`, which may set keys of every section.

    Returns:
      The values of the section `algo`, nested below that name; and the values of all other keys, by
      dotted key.
    """
    if choice is None:
        return {}, {}
    found = read_choice(_WHOLE, choice)
    if not isinstance(found.get(_WHOLE), dict):  # it has keys of its own section only
        return {_WHOLE: found}, {}
    own = found.pop(_WHOLE)
    return {_WHOLE: own}, parse(cls, shared_words(cls, found, Path(choice)))


def shared_words(cls: type[Section], found: Mapping[str, Any], path: Path) -> list[str]:
    """Returns the keys and values of a file for a whole run as `key=value` words.

    Args:
      cls: the command's dataclass. Its `shared` lists the keys and sections that such a file may
        set. The list is short, because the file may come from somebody else.
      found: the keys and values of the file.
      path: the file. Relative paths in the file start from the folder of the file.

    Raises:
      ConfigError: if the file sets any other key.
    """
    for key in found:
        root = key.partition(".")[0]
        if root not in section.names(cls):
            raise ConfigError(f"{path}: {section.unknown_key(root, cls)}")
        if root not in cls.shared:
            raise ConfigError(
                f"{path}: {key} cannot be set in a file, which may set only "
                f"{', '.join(cls.shared)}: give {key} on the command line."
            )
    return write_words(
        {
            key: beside(path.parent, value) if isinstance(value, str) and choices(key) else value
            for key, value in found.items()
        }
    )


def is_path(choice: str) -> bool:
    """Returns whether a choice is the path of a user's file, rather than a name in configs/."""
    return choice.endswith((".yaml", ".yml"))


def beside(folder: Path, choice: str) -> str:
    """Returns a choice made in a user's file, with a relative path joined to that file's folder.

    Args:
      folder: the folder of the file that makes the choice.
      choice: the name of a file in configs/, or the path of another file.
    """
    return str(folder / choice) if is_path(choice) else choice


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Returns nested plain data with some keys replaced.

    Args:
      base: the data.
      over: the keys to replace and their new values, nested in the same way.
    """
    found = dict(base)
    for key, value in over.items():
        inner = found.get(key)
        if isinstance(inner, Mapping) and isinstance(value, Mapping):
            value = merge(inner, value)
        found[key] = value
    return found


# Files


def choices(group: str) -> list[str]:
    """Returns the names of a group's files without `.yaml`; empty if there is no such group."""
    return sorted(path.stem for path in (_config_dir() / group).glob("*.yaml"))


def defaults(command: str) -> dict[str, str]:
    """Returns a command's groups and their default choices, which its file in configs/ lists.

    A command without a file has no groups.
    """
    path = _config_dir() / f"{command}.yaml"
    return reading.read_yaml(path) if path.exists() else {}


def describe_groups(cls: type[Section]) -> list[str]:
    """Returns a line for each group of a command: its default and its choices."""
    found = defaults(cls.command) | {
        group: f"<{text}>" for group, text in cls.inherited.items() if choices(group)
    }
    return [
        f"  {f'{group}={choice}':<38}  ({', '.join(choices(group))})"
        for group, choice in found.items()
    ]


def _config_dir() -> Path:
    """Finds configs/: inside the installed package, otherwise at the root of the source tree."""
    installed = _PACKAGE / "configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"


def read_choice(group: str, choice: str, key: str | None = None) -> dict[str, Any]:
    """Reads the file that the choice of a group names.

    Args:
      group: a folder of configs/.
      choice: the name of a file in that folder, or the path of another file.
      key: name of the setting in messages; None stands for the name of the group.

    Raises:
      ConfigError: if there is no such file, or it cannot be read.
    """
    return reading.read_yaml(named_path(group, choice, key or group))


def named_path(folder: str, choice: str, key: str) -> Path:
    """Returns the path of the file that a choice names, in a folder of configs/ or elsewhere.

    Args:
      folder: a folder of configs/.
      choice: the name of a file in that folder, or the path of another file.
      key: name of the setting in messages.

    Raises:
      ConfigError: if there is no such file.
    """
    check_text(key, choice)
    if is_path(choice):
        if not Path(choice).exists():
            raise ConfigError(f"{key} is '{choice}', but this file does not exist: check the path.")
        return Path(choice)
    names = choices(folder)
    if choice not in names:
        # Short names such as s7 and s6 share half their letters. difflib's default requires 0.6.
        near = difflib.get_close_matches(choice, names, n=1, cutoff=0.5)
        hint = f"give {near[0]} (the most similar name) or" if near else "give"
        if choice.startswith("[") and key == "stage":
            hint = f"give stage=curriculum 'stage.sequence={choice}' for several stages, or"
        file = ", or the path of a .yaml file" if folder in _OWN_FILES else ""
        raise ConfigError(f"{key} is {show(choice)}: {hint} one of {', '.join(names)}{file}.")
    return _config_dir() / folder / f"{choice}.yaml"


# Words


def parse(cls: type[Section], overrides: Sequence[str]) -> dict[str, Any]:
    """Returns the values of a command line by key. If a key is given twice, the last word counts.

    Args:
      cls: the command's dataclass.
      overrides: `key=value` words.

    Returns:
      Plain data by key. The value of a group is its choice, which names a file.

    Raises:
      ConfigError: if a word is not `key=value`, if its key is not in `cls`, if its key can only be
        set by choosing a file, or if its value is not YAML.
    """
    known, derived = section.keys(cls), section.keys(cls, derived=True)
    found = {}
    for i, word in enumerate(overrides):
        key, equals, value = word.partition("=")
        if not equals or len(key) > _MOST_KEY or not re.fullmatch(r"\w[\w-]*(\.[\w-]+)*", key):
            spaces = " without spaces" if overrides[i + 1 : i + 2] == ["="] else ""
            raise ConfigError(f"{show(word)} is not a setting: give key=value{spaces}.")
        root = key.partition(".")[0]
        if root not in section.names(cls):
            raise section.unknown_key(root, cls)
        if key in derived:
            advice = [f": choose a file, as in {root}={name}" for name in choices(root)[-1:]]
            raise ConfigError(f"{key} cannot be set by itself{''.join(advice)}.")
        is_text = key in known and str in values.options(known[key].type)
        if choices(key) or is_text:
            check_text(key, value)
        if choices(key):
            found[key] = value.strip("'\"")
        elif is_text and value != "null" and value[:1] not in ("'", '"'):
            found[key] = value  # without quotes, so that a path may contain any character
        else:
            where = f"{key} is {show(value)}, which cannot be read: "
            found[key] = reading.parse_yaml(value, where)
    return found


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of dotted keys as nested plain data.

    Args:
      flat: values by dotted key.

    Raises:
      ConfigError: if a key such as `a.b` is there, but the value of `a` has no keys.
    """
    found: dict[str, Any] = {}
    for key, value in flat.items():
        *above, last = key.split(".")
        inner = found
        for depth, part in enumerate(above, 1):
            inner = inner.setdefault(part, {})
            if not isinstance(inner, dict):
                whole = ".".join(above[:depth])
                raise ConfigError(
                    f"{key} cannot be set if {whole} is {show(inner)}: leave out one of the two."
                )
        inner[last] = value
    return found


def flatten(nested: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Returns nested settings as values by dotted key; the reverse of `nest`.

    Args:
      nested: plain data, possibly with sections, which are converted to plain data first.
      where: the prefix of the returned keys.
    """
    flat: dict[str, Any] = {}
    for key, value in nested.items():
        value = section.to_dict(value) if isinstance(value, Section) else value
        inner = isinstance(value, Mapping)
        flat |= flatten(value, f"{where}{key}.") if inner else {f"{where}{key}": value}
    return flat


def write_words(nested: Mapping[str, Any]) -> list[str]:
    """Writes nested plain data as `key=value` words."""
    return [f"{key}={write(value)}" for key, value in flatten(nested).items()]


def write(value: Any) -> str:
    """Writes plain data as the value of a word, so that `parse` reads the same data."""
    plain = isinstance(value, str) and re.fullmatch(r"[A-Za-z][\w./-]*", value)
    if plain and value.lower() not in ("null", "true", "false"):
        return value
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))
