"""Composes the files of configs/ and the words of a command line into plain data, with Hydra.

Hydra only composes the YAML files with the `key=value` words. Here Hydra sets up no logging and
does not change the directory. It is imported on first use. `section.build` takes the result.
"""

import contextlib
import difflib
import itertools
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmjax.config import reading, section
from swarmjax.config.section import ConfigError, Section, show

if TYPE_CHECKING:
    from omegaconf import DictConfig

_PACKAGE = Path(__file__).resolve().parents[1]

# Limits on a word of the command line. Hydra's grammar takes seconds to read longer words.
_MOST_KEY = 200  # letters
_MOST_VALUE = 5000  # letters
_MOST_DEPTH = 32  # nested brackets
# In all words together. A reference may contain several others, so only a few more references would
# fill the memory.
_MOST_REFERENCES = 16

# Groups whose message about an unknown choice says that a path is allowed.
_OWN_FILES = ("stage", "recipes")

# Takes the composed data and the choice of each group, and returns the keys and values to check.
Complete = Callable[[dict[str, Any], dict[str, str]], dict[str, Any]]


def compose(
    cls: type[Section], command: str, overrides: Sequence[str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Composes a command's files and words with Hydra.

    Args:
      cls: the command's dataclass, which defines its keys.
      command: name of the command's file in configs/.
      overrides: `key=value` words.

    Returns:
      The keys and values from all sources, and the choice of each group.

    Raises:
      ConfigError: if a word, a choice or a file is invalid.
    """
    words = split_words(cls, overrides)
    groups = {key: choice_of(word) for key, word in words.items() if choices(key)}
    own = {key: choice for key, choice in groups.items() if is_path(choice)}
    for key, choice in groups.items():
        check_choice(key, choice, key)
    for key in words.keys() - groups.keys():
        _parse(words[key])
    for group, choice in (defaults(command) | groups).items():
        read_choice(group, choice)  # this error names a broken file, but Hydra's error does not
    forced = [word if key in groups else f"++{word}" for key, word in words.items()]
    composed, chosen = _hydra(command, [word for word in forced if not _is_of(word, own)])
    mapping = _resolve(composed)
    for group, path in own.items():
        mine = {key: word for key, word in words.items() if key.startswith(f"{group}.")}
        mapping[group] = _merge(read_choice(group, path), values(mine).get(group, {}))
    return mapping, chosen | own


def choice_of(word: str) -> str:
    """Returns the choice that a word makes for a group."""
    return word.partition("=")[2].strip("'\"")


def is_path(choice: str) -> bool:
    """Returns whether the choice of a group is a user's file, and not a name in configs/."""
    return choice.endswith((".yaml", ".yml"))


def beside(folder: Path, choice: str) -> str:
    """Returns a choice made in a user's file; a relative path is meant from that file's folder.

    Args:
      folder: the folder of the file that makes the choice.
      choice: the name of a file in configs/, or the path of another file.
    """
    return str(folder / choice) if is_path(choice) else choice


def _is_of(word: str, groups: Mapping[str, str]) -> bool:
    """Returns whether a word chooses a file for one of these groups, or sets a key in one."""
    return word.removeprefix("++").partition("=")[0].partition(".")[0] in groups


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Returns nested plain data with some keys replaced."""
    found = dict(base)
    for key, value in over.items():
        inner = found.get(key)
        if isinstance(inner, dict) and isinstance(value, Mapping):
            value = _merge(inner, value)
        found[key] = value
    return found


def load[C: Section](cls: type[C], overrides: Sequence[str], complete: Complete | None = None) -> C:
    """Makes a command's settings from its files and its `key=value` words. All commands use it.

    Args:
      cls: the command's dataclass. Its `command` names the file in configs/.
      overrides: the words.
      complete: a function that takes the composed data and the choice of each group, and returns
        the keys and values to check. None checks the composed data itself.

    Returns:
      The settings.

    Raises:
      ConfigError: if a word, a choice, a file or a value is invalid.
    """
    mapping, chosen = compose(cls, cls.command, overrides)
    return section.build(cls, complete(mapping, chosen) if complete else mapping)


# Files


def choices(group: str) -> list[str]:
    """Returns the names of a group's files; empty if it is not a group."""
    return sorted(path.stem for path in (_config_dir() / group).glob("*.yaml"))


def defaults(command: str) -> dict[str, str]:
    """Returns the groups of a command and the choices in its file."""
    entries = read_file(command).get("defaults", [])
    return {
        str(group): str(choice)
        for entry in entries
        if isinstance(entry, dict)
        for group, choice in entry.items()
    }


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
    """Finds configs/: at the root of the source tree, otherwise inside the installed package."""
    root = _PACKAGE.parent
    source, installed = root / "configs", _PACKAGE / "configs"
    # The folder above an installed package also holds other packages. A folder configs/ there is
    # ours only if the project file is next to it.
    if (root / "pyproject.toml").is_file() and source.is_dir():
        return source
    if installed.is_dir():
        return installed
    raise ConfigError(f"configs is missing: neither {source} nor {installed} is a folder.")


def read_file(name: str) -> dict[str, Any]:
    """Reads one file of configs/ without composing it.

    Args:
      name: path of the file in configs/, without the ending, such as `stage/s6`.

    Raises:
      ConfigError: if the file cannot be read.
    """
    return read_yaml(_config_dir() / f"{name}.yaml")


def read_choice(group: str, choice: str) -> dict[str, Any]:
    """Reads the file that the choice of a group names.

    Args:
      group: a folder of configs/.
      choice: the name of a file in that folder, or the path of another file.

    Raises:
      ConfigError: if the file cannot be read, or if it is a user's file that chooses other files.
    """
    if not is_path(choice):
        return read_file(f"{group}/{choice}")
    section.check_text(group, choice)
    found = read_yaml(Path(choice))
    if "defaults" in found:
        raise ConfigError(
            f"{choice} has defaults, which only files of configs/ may have: remove it."
        )
    return found


def read_yaml(path: Path) -> dict[str, Any]:
    """Reads a file of keys and values without composing it.

    Raises:
      ConfigError: if the file cannot be read, or does not hold keys and values.
    """
    mapping = reading.read_yaml(path)
    if mapping is None:
        return {}
    if not isinstance(mapping, dict):
        raise ConfigError(
            f"{reading.called(path)} is not a list of keys and values: write key: value."
        )
    return {str(key): value for key, value in mapping.items()}


def read_preset(group: str, choice: str) -> dict[str, Any]:
    """Reads a preset, which is one file of a group, such as `real` of the group `realism`.

    Raises:
      ConfigError: if there is no such file.
    """
    check_choice(group, choice, group)
    return read_file(f"{group}/{choice}")


def preset_of(group: str, held: Section) -> str:
    """Returns the name of the preset whose values a section has; `custom` if no preset has them."""
    derived = section.keys(type(held), derived=True)

    def numbers(of: Section) -> dict[str, Any]:
        return {key: value for key, value in section.to_dict(of).items() if key not in derived}

    for name in choices(group):
        if numbers(section.build(type(held), read_preset(group, name))) == numbers(held):
            return name
    return "custom"


def named_path(folder: str, choice: str, key: str) -> Path:
    """Returns the file that a choice names: one of a folder of configs/, or a user's own.

    Args:
      folder: a folder of configs/ that is not a group of Hydra.
      choice: the name of a file in that folder, or the path of another file.
      key: name of the setting in messages.

    Raises:
      ConfigError: if there is no such name.
    """
    section.check_text(key, choice)
    if is_path(choice):
        return Path(choice)
    check_choice(folder, choice, key)
    return _config_dir() / folder / f"{choice}.yaml"


def _example(group: str) -> str:
    return f"{group}={choices(group)[-1]}"


def check_choice(group: str, choice: str, key: str) -> None:
    """Refuses a choice that is not a file of a group.

    Args:
      group: a folder of configs/.
      choice: the name of a file in that folder, or the path of another file.
      key: name of the setting in messages.

    Raises:
      ConfigError: if there is no such file.
    """
    names = choices(group)
    if is_path(choice):
        section.check_text(key, choice)
        if not Path(choice).exists():
            raise ConfigError(f"{key} is {show(choice)}, and there is no such file.")
    elif choice not in names:
        # Short names such as s7 and s6 share half their letters. difflib's default requires 0.6.
        near = difflib.get_close_matches(choice, names, n=1, cutoff=0.5)
        hint = f" (nearest: {near[0]})" if near else ""
        file = ", or a file .yaml" if group in _OWN_FILES else ""
        raise ConfigError(f"{key} is {show(choice)}: give one of {', '.join(names)}{hint}{file}.")


# Words


def split_words(cls: type[Section], overrides: Sequence[str]) -> dict[str, str]:
    """Returns the words of a command line by key. If a key is given twice, the last word counts.

    Args:
      cls: the command's dataclass.
      overrides: `key=value` words.

    Returns:
      The words, with text quoted for Hydra's grammar.

    Raises:
      ConfigError: if a word is not `key=value`, if its key is not in `cls`, or if its key can only
        be set by choosing a file.
    """
    roots, derived = section.names(cls), section.keys(cls, derived=True)
    words = {}
    for word in overrides:
        key, equals, _ = word.partition("=")
        if not equals or len(key) > _MOST_KEY or not re.fullmatch(r"\w[\w-]*(\.[\w-]+)*", key):
            raise ConfigError(f"{show(word)} is not a setting: give key=value.")
        root = key.partition(".")[0]
        if root not in roots:
            raise section.unknown_key(root, cls)
        if key in derived:
            raise ConfigError(f"{key} cannot be given: choose a file, as in {_example(root)}.")
        words[key] = word
    texts = {key for key, item in section.keys(cls).items() if str in section.options(item.type)}
    for key, word in words.items():
        _check_word(key, word, is_text=key in texts)
    if sum(word.count("${") for word in words.values()) > _MOST_REFERENCES:
        raise ConfigError(
            f"the arguments use ${{...}} too often: use it at most {_MOST_REFERENCES} times."
        )
    return {key: _quote(word) if key in texts else word for key, word in words.items()}


def _check_word(key: str, word: str, *, is_text: bool) -> None:
    """Refuses words that would take Hydra's grammar too long, and invalid text."""
    value = word.partition("=")[2]
    if is_text or choices(key):
        section.check_text(key, value)
    elif len(value) > _MOST_VALUE:
        raise ConfigError(
            f"{key} is {show(value)}, which has {len(value)} characters: give at most "
            f"{_MOST_VALUE}."
        )
    elif _depth(value) > _MOST_DEPTH:
        raise ConfigError(f"{key} is {show(value)}: nest lists at most {_MOST_DEPTH} deep.")


def _depth(value: str) -> int:
    """Returns the maximum depth of nested brackets in a word."""
    steps = (("[{(".count(letter)) - ("]})".count(letter)) for letter in value)
    return max(itertools.accumulate(steps), default=0)


def values(words: Mapping[str, str]) -> dict[str, Any]:
    """Returns the values of words as nested plain data.

    Args:
      words: the words, as `split_words` returns them.

    Raises:
      ConfigError: if Hydra's grammar cannot read a word, or two words contradict each other.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    given = OmegaConf.create({})
    for key, word in words.items():
        try:
            with _explained([word]):
                OmegaConf.update(given, key, _parse(word))
        except OmegaConfBaseException as error:
            raise ConfigError(f"{show(word)} cannot be used: {_first_line(error)}.") from None
    return _resolve(given)


def _quote(word: str) -> str:
    """Quotes a text for Hydra's grammar, so that a path may contain `=`, a comma or a space."""
    key, _, value = word.partition("=")
    if value in ("", "null") or value[0] in "'\"":
        return word
    return f"{key}={quote(value)}"


def quote(text: str) -> str:
    """Quotes a text so that Hydra's grammar reads it unchanged."""
    from hydra.core.override_parser.types import Quote, QuotedString

    return QuotedString(text=text, quote=Quote.single).with_quotes()


def _parse(word: str) -> object:
    """Parses one word with Hydra's grammar and returns its value."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key = word.partition("=")[0]
    try:
        parsed = OverridesParser.create().parse_override(f"++{word}")
    except (ValueError, OverflowError):  # a number is too long; Hydra has no error for this
        raise ConfigError(f"{show(word)} cannot be used: give a number of fewer digits.") from None
    except HydraException:
        raise ConfigError(
            f"{show(word)} cannot be read: quote a value with special characters, "
            f"as in \"{key}='a=b'\"."
        ) from None
    if parsed.is_sweep_override():
        raise ConfigError(
            f"{show(word)} gives several values, and a run takes one: write a list as {key}=[1,2]."
        )
    return parsed.value()


# Hydra


def _hydra(command: str, overrides: list[str]) -> tuple["DictConfig", dict[str, str]]:
    """Composes with a separate Hydra instance, and then restores the caller's instance, if any.

    Hydra also returns the choice of each group, because a file may choose files of other groups.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import open_dict
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with (
            _explained(overrides),
            hydra.initialize_config_dir(config_dir=str(_config_dir()), version_base="1.3"),
        ):
            composed = hydra.compose(command, overrides=overrides, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(f"the settings do not fit together: {_first_line(error)}.") from None
    finally:
        GlobalHydra.instance().hydra = outer
    chosen = {group: composed.hydra.runtime.choices[group] for group in defaults(command)}
    with open_dict(composed):
        del composed["hydra"]
    return composed, chosen


@contextlib.contextmanager
def _explained(words: Iterable[str]) -> Iterator[None]:
    """Explains the error if a key continues inside a list, where OmegaConf expects an index."""
    try:
        yield
    except (TypeError, ValueError) as error:
        for word, part in itertools.product(words, re.findall(r"'([^']*)'", str(error))):
            key = word.removeprefix("++").partition("=")[0]
            start, within, _ = f"{key}.".partition(f".{part}.")
            if within and not isinstance(error, ConfigError):
                said = f"{key} is not a key: {start} is a list, give {start}=[...]."
                raise ConfigError(said) from None
        raise


def _resolve(config: "DictConfig") -> dict[str, Any]:
    """Returns Hydra's composed config as plain data, with its interpolations resolved."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        mapping = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (OmegaConfBaseException, ValueError, RecursionError) as error:
        raise ConfigError(f"the settings cannot be resolved: {_first_line(error)}.") from None
    return typing.cast(dict[str, Any], mapping)


def _first_line(error: Exception) -> str:
    line = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
    return line if len(line) <= _MOST_KEY else f"{line[: _MOST_KEY - 3]}..."
