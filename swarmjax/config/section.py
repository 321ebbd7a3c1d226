"""Sections of settings: strict conversion, bounds, and one-sentence errors.

A section is a frozen dataclass. Each field carries its meaning and bounds as metadata (`setting`).
`build` makes a section from plain data, and `to_dict` converts it back. This module does not know
what the settings are for.
"""

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from swarmjax.config import reading, values
from swarmjax.config.values import ConfigError, check_text, show

MAX_COUNT = 2**31 - 1  # counts and seeds are int32 on the device
# Other numbers are float32, which holds nothing beyond `_LARGEST`. A device replaces a number by 0
# if the number is nearer to 0 than `_SMALLEST`.
_LARGEST, _SMALLEST = 3.4e38, 1.2e-38


class UnknownKeyError(ConfigError):
    """Refuses a key that does not exist."""


@dataclass(frozen=True)
class Bounds:
    """The numbers that a setting accepts: low..high inclusive, above..below exclusive."""

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf  # the value must exceed it
    below: float = math.inf
    reason: str = ""  # why `high` is the limit, and how to raise it

    def check(self, key: str, value: object, number: float) -> None:
        """Refuses a number out of bounds, or one that float32 cannot hold.

        Args:
          key: name of the setting in the message.
          value: the whole value that was given.
          number: the number in it to check.
        """
        inside = self.low <= number <= self.high and self.above < number < self.below
        fits = number == 0 or _SMALLEST <= abs(number) <= _LARGEST
        if inside and fits:
            return
        why = f"; {self.reason}" if self.reason and number > self.high else ""
        if inside:
            why = f"; float32 holds 0 and magnitudes of {_SMALLEST:g} to {_LARGEST:g}"
        raise ConfigError(f"{key} is {show(value)}: give {self}{why}.")

    def __str__(self) -> str:
        if math.isfinite(self.low) and math.isfinite(self.high):
            return f"{show(self.low)} to {show(self.high)}"
        ends = {
            "{} or more": self.low,
            "more than {}": self.above,
            "at most {}": self.high,
            "less than {}": self.below,
        }
        given = [text.format(show(end)) for text, end in ends.items() if math.isfinite(end)]
        return ", ".join(given) or "any finite number"


def about(  # most calls give two or three
    meaning: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    derived: bool = False,
    stored: bool = True,
    **bounds: Any,
) -> dict[str, Any]:
    """Returns the metadata of a field.

    Args:
      meaning: the meaning of the key, with its unit.
      low: the smallest number that the key accepts.
      high: the largest number that the key accepts.
      derived: whether the chosen files determine the value, so that the command line cannot set it.
      stored: whether `to_dict` keeps the field.
      bounds: further fields of `Bounds`.
    """
    allowed = Bounds(low, high, **bounds)
    return {"meaning": meaning, "bounds": allowed, "derived": derived, "stored": stored}


def setting(default: Any, meaning: str, *limits: float, **more: Any) -> Any:
    """Returns a field with a default; all other arguments are those of `about`."""
    return field(default=default, metadata=about(meaning, *limits, **more))


@dataclass(frozen=True, kw_only=True)
class Section:
    """A group of settings. When a section is made, its numbers are checked against their bounds.

    Attributes:
      command: name of the command's file in configs/, if the section holds all keys of a command.
      inherited: for each section by name, where its values come from if no word sets them.
      shared: the keys and sections that a file for the whole config, such as a recipe, may set.
    """

    command: ClassVar[str] = ""
    inherited: ClassVar[Mapping[str, str]] = {}
    shared: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value, bounds = getattr(self, item.name), item.metadata.get("bounds", Bounds())
            for number in _leaves(value):
                if isinstance(number, int | float):
                    bounds.check(item.name, value, number)
        self._check()

    def _check(self) -> None:
        """Refuses invalid combinations of values.

        Messages give the keys without the section's name.
        """


def check_options(section: Section, options: Mapping[str, tuple[str, Sequence[str]]]) -> None:
    """Refuses an option that nothing would read.

    Args:
      section: the settings.
      options: for each option, the key that decides whether it is read, and the values of that key
        with which it is read. With other values, the option must have its default.

    Raises:
      ConfigError: an option has another value than its default, and is not read.
    """
    defaults = {item.name: item.default for item in dataclasses.fields(section)}
    for key, (selector, choices) in options.items():
        value, chosen, default = getattr(section, key), getattr(section, selector), defaults[key]
        if chosen not in choices and value != default:
            raise ConfigError(
                f"{key} is {show(value, quote='')}, but {selector} is {chosen} and does not use "
                f"{key}: leave {key} at {show(default, quote='')}, or give "
                f"{selector}={' or '.join(choices)}."
            )


class ByName(dict[str, Any]):
    """A mapping from names to values, where no section defines the names.

    It is never changed, so that settings are hashable.
    """

    def __hash__(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return hash(frozenset(self.items()))


def _leaves(value: object) -> Iterator[object]:
    """Yields a value, or the values within nested tuples and `ByName`."""
    if isinstance(value, tuple | ByName):
        for item in value.values() if isinstance(value, ByName) else value:
            yield from _leaves(item)
    else:
        yield value


# From and to plain data


def build[C: Section](cls: type[C], mapping: Mapping[str, Any], where: str = "") -> C:
    """Makes a section from plain data, strictly.

    Whole numbers become integers or floats, and lists become tuples. Nothing else is converted, and
    no key is dropped.

    Args:
      cls: the dataclass to make.
      mapping: keys and values of the dataclass, as `to_dict`, JSON or YAML give them.
      where: the prefix of the keys in messages, such as `sim.`.

    Returns:
      An instance of `cls`.

    Raises:
      ConfigError: if a key is unknown or missing, or a value has a wrong type or is out of bounds.
    """
    known = {item.name: item for item in dataclasses.fields(cls)}
    if not isinstance(mapping, Mapping):
        key = where.rstrip(": .")
        first = f"{where}{next(iter(known))}"
        raise ConfigError(f"{key} is {show(mapping)}: give one of its keys, such as {first}.")
    for key in mapping:
        if key not in known:
            raise unknown_key(str(key), cls, where)
    for key, item in known.items():
        if key not in mapping and _is_required(item):
            raise ConfigError(f"{where}{key} is missing and has no default: give it a value.")
    made = {key: convert(known[key].type, value, f"{where}{key}") for key, value in mapping.items()}
    try:
        return cls(**made)
    except ConfigError as error:
        raise ConfigError(f"{where}{error}") from None


def build_stored[C: Section](cls: type[C], stored: Any, where: str) -> C:
    """Makes a section as `build` does, from what a run directory or a policy holds.

    Args:
      cls: the dataclass to make.
      stored: the result of `to_dict`, perhaps of an older version.
      where: the prefix of the keys in messages.

    Raises:
      ConfigError: as `build`; for a key that this version lacks, it says that an
        older version may read it.
    """
    try:
        return build(cls, stored, where)
    except UnknownKeyError as error:
        key = str(error).partition(" is not a key: ")[0]
        raise ConfigError(
            f"{key} is not a key of this version: if an older version wrote it, use that version."
        ) from None


def convert(hint: object, value: object, key: str) -> object:
    """Converts plain data to a field's type.

    Args:
      hint: the type.
      value: the data.
      key: name of the setting in messages.

    Raises:
      ConfigError: if the data cannot be converted.
    """
    kinds = values.options(hint)
    lists = [each for each in kinds if values.is_list(each)]
    single = (value is None and types.NoneType in kinds) or (
        float in kinds and not isinstance(value, list | tuple)
    )
    if lists and not single:
        return _listed(lists[0], value, key)
    if typing.get_origin(hint) is dict:
        return _by_name(typing.get_args(hint)[1], value, key)
    section = _section(hint)
    if section is not None:
        mapping = typing.cast(Mapping[str, Any], value)
        return build(section, mapping, key if key.endswith(": ") else f"{key}.")
    return values.convert_single(hint, value, key)


def _listed(hint: object, value: object, key: str) -> tuple[object, ...]:
    """Converts a list of values of one type. Messages call each of several sections by its name."""
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{key} is {show(value)}: give {values.describe(hint)}.")
    inner = typing.get_args(hint)[0]
    names = [key] * len(value)
    if _section(hint) is not None and len(value) > 1:
        numbered = enumerate(value)
        own = (each.get("name", i) if isinstance(each, Mapping) else i for i, each in numbered)
        names = [f"{key} {name}: " for name in own]
    return tuple(convert(inner, item, name) for item, name in zip(value, names, strict=True))


def _by_name(hint: object, value: object, key: str) -> ByName:
    """Converts a mapping from names, which no section defines, to values of one type."""
    if not isinstance(value, Mapping):
        raise ConfigError(f"{key} is {show(value)}: give named values, as in {key}.NAME=1.")
    for name in value:
        check_text(key, str(name))
    return ByName({str(name): convert(hint, each, f"{key}.{name}") for name, each in value.items()})


def to_dict(config: Section) -> dict[str, Any]:
    """Returns a section as plain data for JSON. `build` reverses this."""
    return {
        item.name: _plain(getattr(config, item.name))
        for item in dataclasses.fields(config)
        if item.metadata.get("stored", True)
    }


def _plain(value: object) -> object:
    """Turns sections into dictionaries, and tuples into lists."""
    if isinstance(value, Section):
        return to_dict(value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


# Keys


def names(cls: type[Section]) -> list[str]:
    """Returns the keys and sections with which a word of the command line may begin."""
    return [item.name for item in dataclasses.fields(cls) if not _is_derived(item)]


def keys(
    cls: type[Section], where: str = "", *, derived: bool = False
) -> dict[str, dataclasses.Field[Any]]:
    """Returns the dotted keys of the command line and the fields that they set.

    Args:
      cls: the section.
      where: the prefix of its keys.
      derived: whether to return the derived fields instead, which the command line cannot set.
    """
    found = {}
    for item in dataclasses.fields(cls):
        inner = _section(item.type)
        if inner is not None:
            found |= keys(inner, f"{where}{item.name}.", derived=derived)
        elif _is_derived(item) == derived:
            found[f"{where}{item.name}"] = item
    return found


def sections(cls: type[Section]) -> dict[str, type[Section]]:
    """Returns the sections within a section, by name."""
    found = {item.name: _section(item.type) for item in dataclasses.fields(cls)}
    return {name: inner for name, inner in found.items() if inner is not None}


class KeyLine(NamedTuple):
    """The documentation of a key, as text.

    Attributes:
      key: the dotted key.
      default: the key's default as it would be typed, or the source of the default in angle
        brackets.
      meaning: meaning and unit of the key; empty if the field states none.
      allowed: the type and bounds of its values.
    """

    key: str
    default: str
    meaning: str
    allowed: str


def list_keys(cls: type[Section], chosen: Collection[str] | None = None) -> list[KeyLine]:
    """Returns the documentation of each key.

    Args:
      cls: the section.
      chosen: the keys to list; None for all.
    """
    known = keys(cls).items()
    return [_key_line(cls, key, item) for key, item in known if chosen is None or key in chosen]


def _key_line(cls: type[Section], key: str, item: dataclasses.Field[Any]) -> KeyLine:
    section = key.partition(".")[0]
    default = f"<{'required' if section == key else f'the {section}'}>"
    if section in cls.inherited and section != key:
        default = f"<{cls.inherited[section]}>"
    elif not _is_required(item):
        made = item.default_factory() if callable(item.default_factory) else item.default
        default = show(made, quote="")
    bounds = item.metadata.get("bounds", Bounds())
    allowed = values.describe(item.type, "" if bounds == Bounds() else f" {bounds}")
    return KeyLine(key, default, item.metadata.get("meaning", ""), allowed)


def describe_keys(cls: type[Section], chosen: Collection[str] | None = None) -> list[str]:
    """Returns a line for each key: its default, its meaning and its allowed values.

    Args:
      cls: the section.
      chosen: the keys to describe; None for all.
    """
    return [
        f"  {f'{line.key}={line.default}':<38}  {line.meaning} ({line.allowed})"
        for line in list_keys(cls, chosen)
    ]


def unknown_key(key: str, cls: type[Section], where: str = "") -> ConfigError:
    """Makes the error for a key that does not exist, and names the key that was probably meant.

    Args:
      key: the key as it was given, without its prefix.
      cls: the section that has no such key.
      where: the prefix of the key, such as `sim.`.
    """
    known = names(cls)
    dotted = {full.rpartition(".")[2]: full for full in reversed(keys(cls))}
    path = Path(__file__).with_name(f"synonyms_{cls.command}.yaml")
    synonyms = reading.read_yaml(path) if path.exists() else {}
    near = [meant for meant, others in synonyms.items() if key in others]
    near = near or ([dotted[key]] if key in dotted else difflib.get_close_matches(key, known, n=1))
    near = near or [dotted[name] for name in difflib.get_close_matches(key, dotted, n=1)]
    meant = f" or {where}".join(near)
    hint = f"did you mean {where}{meant}?" if near else f"give one of {', '.join(known)}."
    return UnknownKeyError(f"{where}{key} is not a key: {hint}")


def _is_derived(item: dataclasses.Field[Any]) -> bool:
    return item.metadata.get("derived", False)


def _is_required(item: dataclasses.Field[Any]) -> bool:
    return item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING


def _section(hint: object) -> type[Section] | None:
    """Returns the section type of a field, which may be within a tuple; None if it has none."""
    inner = typing.get_args(hint)[0] if typing.get_origin(hint) is tuple else hint
    return inner if isinstance(inner, type) and issubclass(inner, Section) else None
