"""Sections of settings: strict conversion, bounds, and mistakes put in one sentence each.

A section is a frozen dataclass whose fields say with `about` what they mean and which numbers
they take. `build` makes one from plain data, `to_dict` turns it back. What the settings are for
is not known here.
"""

import dataclasses
import difflib
import itertools
import math
import types
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

MAX_COUNT = 2**31 - 1  # counts and seeds are int32 on the device
# All else is computed in float32: nothing lies beyond, and nearer to 0 a device computes with 0.
_LARGEST, _SMALLEST = 3.4e38, 1.2e-38
_MOST_NAME = 255  # bytes of the name of a file, by Linux, macOS and Windows
_MOST_PATH = 4095  # bytes of a path on Linux, which has most
_MOST_BITS = 13_000  # of a number that is written; Python refuses to write more than 4300 digits
_SHOWN = 80  # letters that a sentence has of a value


class ConfigError(ValueError):
    """A setting that is refused, in one sentence for the person who typed it."""


@dataclass(frozen=True)
class Bounds:
    """The numbers that a setting takes: low..high with its ends, above..below without them."""

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    reason: str = ""  # why no more is taken than `high`, and what to do about it

    def hold(self, value: float) -> bool:
        """Tell whether a number lies within, and float32 can hold it."""
        inside = self.low <= value <= self.high and self.above < value < self.below
        return inside and _fits(value)

    def refuse(self, key: str, value: object, number: float) -> ConfigError:
        """Say what to give instead of a number.

        Args:
            key: what a sentence calls the setting.
            value: all that was given.
            number: that of it which does not hold.
        """
        why = f"; {self.reason}" if self.reason and number > self.high else ""
        if number != 0 and self.low <= number <= self.high and not _fits(number):
            why = f"; float32 holds 0 and sizes of {_SMALLEST:g} to {_LARGEST:g}"
        return ConfigError(f"{key} is {show(value)}: give {self}{why}.")

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


def about(  # noqa: PLR0913  # most fields give two or three
    meaning: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    derived: bool = False,
    stored: bool = True,
    renamed: Mapping[str, str] | None = None,
    reason: str = "",
) -> dict[str, Any]:
    """Return the metadata of a field.

    Args:
        meaning: what it is, with its unit.
        low: the least number it takes.
        high: the largest.
        above: a number that it must exceed.
        below: a number that it must not reach.
        derived: whether it follows from the files chosen, and is no key of the command line.
        stored: whether `to_dict` keeps it; what is not stored is worked out again.
        renamed: values that have a new name, by the old one.
        reason: why `high` is the largest and how to raise it, for whoever gives more.
    """
    bounds = Bounds(low, high, above, below, reason)
    found = {"meaning": meaning, "bounds": bounds, "renamed": renamed or {}}
    return found | {"derived": derived, "stored": stored}


@dataclass(frozen=True, kw_only=True)
class Section:
    """A group of settings, whose numbers are held to their bounds when it is made.

    Attributes:
        command: name of the command's file in configs/, of a section that is all of a command's.
        removed: why a key is gone, by its old name.
        renamed: a key's new name, by its old one.
        inherited: what a section's values are where no word sets them, by the section's name.
    """

    command: ClassVar[str] = ""
    removed: ClassVar[Mapping[str, str]] = {}
    renamed: ClassVar[Mapping[str, str]] = {}
    inherited: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            bounds = item.metadata.get("bounds", Bounds())
            for number in _leaves(value):
                if isinstance(number, int | float) and not bounds.hold(number):
                    raise bounds.refuse(item.name, value, number)
            for ends in _ranges(item.type, value):
                _check_range(item.name, ends)
        self._check()

    def _check(self) -> None:
        """Refuse what no single bound can say; keys are named from this section on."""


class ByName(dict[str, Any]):
    """Values by names that the section does not know; never edited, so that settings hash."""

    def __hash__(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return hash(frozenset(self.items()))


def _fits(number: float) -> bool:
    """Tell whether a number is 0 or of a size that float32 holds."""
    return number == 0 or _SMALLEST <= abs(number) <= _LARGEST


def _leaves(value: object) -> Iterator[object]:
    """Yield a value, or what stands in nested tuples and by name."""
    if isinstance(value, tuple | ByName):
        for item in value.values() if isinstance(value, ByName) else value:
            yield from _leaves(item)
    else:
        yield value


def _ranges(hint: object, value: object) -> Iterator[tuple[Any, ...]]:
    """Yield the ranges that a value is or holds."""
    if isinstance(value, tuple) and _is_list(hint):
        for item in value:
            yield from _ranges(typing.get_args(hint)[0], item)
    elif isinstance(value, tuple) and any(map(_is_range, options(hint))):
        yield value


def _check_range(key: str, value: tuple[Any, ...]) -> None:
    if len(value) != 2:
        raise ConfigError(f"{key} is {show(value)}: give two numbers.")
    if value[0] > value[1]:
        raise ConfigError(f"{key} is {show(value)}: give the lower number first.")


def build[C: Section](cls: type[C], mapping: Mapping[str, Any], where: str = "") -> C:
    """Make a section from plain data, strictly.

    Whole floats and numeric strings become integers, integers become floats, and lists become
    tuples; nothing else is converted, and no key is dropped.

    Args:
        cls: the dataclass to make.
        mapping: its keys and values, as `to_dict`, JSON or YAML give them.
        where: what comes before its keys in a sentence, such as `sim.`.

    Returns:
        An instance of `cls`.

    Raises:
        ConfigError: an unknown or missing key, a wrong type, or a value out of bounds.
    """
    if not isinstance(mapping, Mapping):
        key = where.rstrip(": .")
        example = dataclasses.fields(cls)[0].name
        raise ConfigError(f"{key} is {show(mapping)}: give keys of its own, as {where}{example}.")
    known = {item.name: item for item in dataclasses.fields(cls)}
    for key in mapping:
        if key not in known:
            raise unknown_key(str(key), cls, where)
    for item in known.values():
        if item.name not in mapping and _is_required(item):
            raise ConfigError(f"{where}{item.name} is missing and has no default: give it.")
    for key, value in mapping.items():
        _refuse_renamed(known[key], value, f"{where}{key}")
    values = {
        key: convert(known[key].type, value, f"{where}{key}") for key, value in mapping.items()
    }
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}{error}") from None


def _refuse_renamed(item: dataclasses.Field[Any], value: object, key: str) -> None:
    """Refuse a value's old name with its new one."""
    renamed = item.metadata.get("renamed", {})
    if isinstance(value, str) and value in renamed:
        new = renamed[value]
        raise ConfigError(f"{key} is {value}, which is called {new} now: give {new}.")


def to_dict(config: Section) -> dict[str, Any]:
    """Return a section as plain data for JSON, from which `build` makes it again."""
    found = {}
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if item.metadata.get("stored", True):
            found[item.name] = _plain(value)
    return found


def modernise(cls: type[Section], stored: Any) -> Any:
    """Give stored settings the names of this version, so that `build` takes them.

    Args:
        cls: the section that they are of.
        stored: plain data of this version or of an older one.

    Returns:
        The same with keys and values by their new names, and without keys that are gone; what is
        no section is left as it is, for `build` to refuse.
    """
    if not isinstance(stored, Mapping):
        return stored
    fields = {item.name: item for item in dataclasses.fields(cls)}
    found = {}
    for old, value in stored.items():
        key = cls.renamed.get(old, old)
        if key in fields:
            found[key] = _modernise_value(fields[key], value)
        elif key not in cls.removed:
            found[key] = value
    return found


def _modernise_value(item: dataclasses.Field[Any], value: Any) -> Any:
    inner = _section(item.type)
    if inner is not None and isinstance(value, list | tuple):
        return [modernise(inner, each) for each in value]
    if inner is not None:
        return modernise(inner, value)
    renamed = item.metadata.get("renamed", {})
    return renamed.get(value, value) if isinstance(value, str) else value


def _plain(value: object) -> object:
    """Turn sections into dictionaries, and tuples into lists."""
    if isinstance(value, Section):
        return to_dict(value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


# Keys


def names(cls: type[Section]) -> list[str]:
    """Return the keys and sections that a word of the command line may begin with."""
    return [item.name for item in dataclasses.fields(cls) if not _is_derived(item)]


def keys(
    cls: type[Section], where: str = "", *, derived: bool = False
) -> dict[str, dataclasses.Field[Any]]:
    """Return the dotted keys of the command line and the fields they set.

    Args:
        cls: the section they are of.
        where: what comes before its keys.
        derived: return the derived fields instead, which the command line does not set.
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
    """Return the sections within a section, by their names."""
    found = {item.name: _section(item.type) for item in dataclasses.fields(cls)}
    return {name: inner for name, inner in found.items() if inner is not None}


class KeyLine(NamedTuple):
    """What is said about a key, as text.

    Attributes:
        key: dotted.
        default: as it would be typed, or in angle brackets where it comes from.
        meaning: what it is, with its unit; empty where nothing was written.
        allowed: the type and the bounds of its values.
    """

    key: str
    default: str
    meaning: str
    allowed: str


def list_keys(cls: type[Section], chosen: Collection[str] | None = None) -> list[KeyLine]:
    """Return the documentation of each key.

    Args:
        cls: the section that they are of.
        chosen: the keys to list; None for all.
    """
    known = keys(cls).items()
    return [_key_line(cls, key, item) for key, item in known if chosen is None or key in chosen]


def _key_line(cls: type[Section], key: str, item: dataclasses.Field[Any]) -> KeyLine:
    section = key.partition(".")[0]
    default = f"<{'required' if section == key else f'the {section}'}>"
    if section in cls.inherited and section != key:
        default = f"<{cls.inherited[section]}>"
    elif item.default_factory is not dataclasses.MISSING:
        default = show(item.default_factory(), quote="")
    elif item.default is not dataclasses.MISSING:
        default = show(item.default, quote="")
    bounds = item.metadata.get("bounds", Bounds())
    allowed = _describe(item.type, "" if bounds == Bounds() else f" {bounds}")
    return KeyLine(key, default, item.metadata.get("meaning", ""), allowed)


def describe_keys(cls: type[Section], chosen: Collection[str] | None = None) -> list[str]:
    """Return a line for each key: its default, its meaning and what it takes.

    Args:
        cls: the section that they are of.
        chosen: the keys to describe; None for all.
    """
    return [
        f"  {f'{line.key}={line.default}':<38}  {line.meaning} ({line.allowed})"
        for line in list_keys(cls, chosen)
    ]


def unknown_key(key: str, cls: type[Section], where: str = "") -> ConfigError:
    """Say that a key does not exist, and which one was probably meant.

    Args:
        key: as it was given, without what stands before it.
        cls: the section that has no such key.
        where: what stands before it, such as `sim.`.
    """
    if key in cls.removed:
        return ConfigError(f"{where}{key} is no longer a key: {cls.removed[key]}")
    if key in cls.renamed:
        new = cls.renamed[key]
        return ConfigError(f"{where}{key} is called {where}{new} now: give {where}{new}.")
    known = names(cls)
    dotted = {full.rpartition(".")[2]: full for full in reversed(keys(cls))}
    once = {name: name for name in known} | dict(cls.renamed)
    near = [dotted[key]] if key in dotted else _near(key, once)
    near = near or _near(key, dotted)
    hint = f"did you mean {where}{near[0]}?" if near else f"give one of {', '.join(known)}."
    return ConfigError(f"{where}{key} is not a key: {hint}")


def _near(key: str, meant: Mapping[str, str]) -> list[str]:
    """Return what the name nearest to a key stands for, if one is near."""
    return [meant[name] for name in difflib.get_close_matches(key, meant, n=1)]


def _is_derived(item: dataclasses.Field[Any]) -> bool:
    return item.metadata.get("derived", False)


def _is_required(item: dataclasses.Field[Any]) -> bool:
    return item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING


# Types


def options(hint: object) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return typing.get_args(hint)
    return (types.NoneType,) if hint is None else (hint,)


def _section(hint: object) -> type[Section] | None:
    """Return the section that a field holds, alone or in a tuple, if it holds one."""
    inner = typing.get_args(hint)[0] if typing.get_origin(hint) is tuple else hint
    return inner if isinstance(inner, type) and issubclass(inner, Section) else None


def _is_range(hint: object) -> bool:
    """Tell whether a type is that of two numbers, the lower first."""
    return typing.get_origin(hint) is tuple and Ellipsis not in typing.get_args(hint)


def _is_list(hint: object) -> bool:
    return typing.get_origin(hint) is tuple and Ellipsis in typing.get_args(hint)


def convert(hint: object, value: object, key: str) -> object:
    """Turn plain data into what a field's type says.

    Args:
        hint: the type.
        value: the data.
        key: what a sentence calls it.

    Raises:
        ConfigError: it cannot be turned into that.
    """
    section, lists = _section(hint), [each for each in options(hint) if _is_list(each)]
    if lists and not (value is None and type(None) in options(hint)):
        return _listed(lists[0], value, key)
    if typing.get_origin(hint) is dict:
        return _by_name(typing.get_args(hint)[1], value, key)
    if section is not None:
        mapping = typing.cast(Mapping[str, Any], value)
        return build(section, mapping, key if key.endswith(": ") else f"{key}.")
    if hint is None and value is not None:
        raise ConfigError(f"{key} is {show(value)}, but is not built yet: leave it out.")
    if isinstance(value, str) and str in options(hint):
        check_text(key, value)
    for option in options(hint):
        try:
            return _scalar(option, value)
        except (TypeError, ValueError, OverflowError):
            continue
    raise ConfigError(f"{key} is {show(value)}: give {_describe(hint)}.")


def _listed(hint: object, value: object, key: str) -> tuple[object, ...]:
    """Convert a list of values of one type."""
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{key} is {show(value)}: give {_describe(hint)}.")
    inner = typing.get_args(hint)[0]
    section = _section(hint)
    return tuple(
        convert(inner, item, _item_key(key, value, index) if section else key)
        for index, item in enumerate(value)
    )


def _by_name(hint: object, value: object, key: str) -> "ByName":
    """Convert values of one type, by names that the section does not know."""
    if not isinstance(value, Mapping):
        raise ConfigError(f"{key} is {show(value)}: give values by name, as in {key}.NAME=1.")
    for name in value:
        check_text(key, str(name))
    return ByName({str(name): convert(hint, each, f"{key}.{name}") for name, each in value.items()})


def _item_key(key: str, items: Sequence[Any], index: int) -> str:
    """Name one of several sections, by its name where it has one."""
    if len(items) == 1:
        return key
    item = items[index]
    name = item.get("name", index) if isinstance(item, Mapping) else index
    return f"{key} {name}: "


def _scalar(hint: object, value: object) -> object:
    """Convert to one scalar type or range, or raise an error that `convert` puts in words."""
    if typing.get_origin(hint) is Literal:
        if isinstance(value, str) and value in typing.get_args(hint):
            return value
    elif _is_range(hint):
        if isinstance(value, list | tuple) and len(value) == 2:
            return tuple(_number(typing.get_args(hint)[0], number) for number in value)
    elif hint is int or hint is float:
        return _number(hint, value)
    elif isinstance(hint, type) and isinstance(value, hint) and value != "":
        return value
    raise TypeError


def check_text(key: str, text: str) -> None:
    """Refuse text that no path or name can be, before anything is done with it.

    Args:
        key: what a sentence calls it.
        text: a path, a name, or several with commas between them.

    Raises:
        ConfigError: it has a control character, is no Unicode, or names what no file can be called.
    """
    if any(ord(letter) < 32 or 127 <= ord(letter) < 160 for letter in text):
        raise ConfigError(f"{key} is {show(text)}: give text without control characters.")
    try:
        content = text.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{key} is {show(text)}: give text in UTF-8.") from None
    for path in content.split(b","):
        for parts, most in (([path], _MOST_PATH), (path.split(b"/"), _MOST_NAME)):
            longest = max(map(len, parts))
            if longest > most:
                what = "path" if parts == [path] and most == _MOST_PATH else "name"
                raise ConfigError(
                    f"{key} is {show(text)}, with a {what} of {longest} bytes: give at most {most}."
                )


def _number(kind: type[int] | type[float], value: object) -> int | float:
    """Convert a number, or a string that is one; true and false are no numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise TypeError
    try:
        number: int | float = int(value) if isinstance(value, str) else value
    except ValueError:
        number = float(value)
    if isinstance(number, float) and not math.isfinite(number):
        raise ValueError
    if kind is int and number != int(number):
        raise ValueError
    return kind(number)


# Words


def _describe(hint: object, bounds: str = "") -> str:
    """Put a field's type in words, and the bounds of its numbers if they are given."""
    if _is_list(hint):
        examples = {int: "[64,64]", str: "[s1,s2]", float | tuple[float, float]: "[0.7,[0.8,1.2]]"}
        inner = typing.get_args(hint)[0]
        return f"a list, as in {examples[inner]}{bounds}" if inner in examples else "a list"
    if typing.get_origin(hint) is dict:
        return "values by name"
    words = []
    for option in options(hint):
        if _is_list(option):
            words.append(_describe(option, bounds))
        elif typing.get_origin(option) is Literal:
            words += typing.get_args(option)
        elif _is_range(option):
            whole = "whole " if typing.get_args(option)[0] is int else ""
            words.append(f"a range [low,high] of {whole}numbers{bounds}")
        else:
            names = {int: f"a whole number{bounds}", float: f"a number{bounds}", str: "text"}
            words.append((names | {bool: "true or false", types.NoneType: "null"})[option])
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def show(value: object, quote: str = "'") -> str:
    """Write a value as it would be typed, and short.

    Args:
        value: plain data.
        quote: what stands around text.
    """
    if isinstance(value, str):
        value = value[:_SHOWN]
        text = value.encode("unicode_escape").decode("ascii") if not value.isprintable() else value
        text = f"{quote}{text}{quote}"
    elif value is None or isinstance(value, bool):
        text = {None: "null", True: "true", False: "false"}[value]
    elif isinstance(value, list | tuple):
        text = f"[{','.join(show(item, quote) for item in value[:_SHOWN])}]"
    elif isinstance(value, Mapping):
        items = itertools.islice(value.items(), _SHOWN)
        text = ", ".join(f"{show(key)}: {show(item)}" for key, item in items).join("{}")
    elif isinstance(value, int) and value.bit_length() > _MOST_BITS:
        text = f"a number of {round(value.bit_length() * math.log10(2))} digits"
    else:
        text = f"{value:.10g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
