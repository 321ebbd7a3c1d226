"""Converts single values to the type of a setting, and formats values and types for messages."""

import itertools
import math
import re
import types
import typing
import unicodedata
from collections.abc import Mapping
from typing import Any, Literal

_MOST_NAME = 255  # bytes in a file name, on Linux, macOS and Windows
_MOST_BITS = 13_000  # messages print shorter numbers; Python refuses to print over 4300 digits
_SHOWN = 80  # characters of a value that a message shows
# The name of each type in messages. `_LISTS` below has an example list for each type of item.
_NAMES = {
    int: "a whole number",
    float: "a number",
    str: "text",
    bool: "true or false",
    types.NoneType: "null",
}
_POWERS = {"k": 3, "M": 6, "G": 9}  # the power of ten that a suffix stands for
_LISTS = {
    int: "[64,64]",
    float: "[0.9,0.8]",
    str: "[s1,s2]",
    float | tuple[float, float]: "[0.7,[0.8,1.2]]",
    tuple[float, float, float]: "[[0.03,-0.01,-0.3],[0.03,0.01,0.3]]",
}


class ConfigError(ValueError):
    """Tells the user in one sentence why a setting is refused."""


def options(hint: object) -> tuple[Any, ...]:
    """Returns the members of a union type; for any other type, the type as the only member."""
    is_union = typing.get_origin(hint) in (types.UnionType, typing.Union)
    return typing.get_args(hint) if is_union else (hint,)


def is_range(hint: object) -> bool:
    """Returns whether a type is a tuple of fixed length: a range (low, high), or more numbers."""
    return typing.get_origin(hint) is tuple and Ellipsis not in typing.get_args(hint)


def is_list(hint: object) -> bool:
    """Returns whether a type is a list of any length."""
    return typing.get_origin(hint) is tuple and Ellipsis in typing.get_args(hint)


def convert_single(hint: object, value: object, key: str) -> object:
    """Converts plain data to the type of a setting that is no list and no section.

    Args:
      hint: the type; it may be a union.
      value: text, a number, true, false, null, or the numbers of a range.
      key: name of the setting in messages.

    Raises:
      ConfigError: if the value does not fit the type.
    """
    if isinstance(value, str) and str in options(hint):
        check_text(key, value)
    for option in options(hint):
        try:
            made = _convert(option, value)
        except (TypeError, ValueError, OverflowError):
            continue
        if len(values := made if isinstance(made, tuple) else ()) == 2 and values[0] > values[1]:
            raise ConfigError(f"{key} is {show(value)}: give the lower number first.")
        return made
    power = re.fullmatch(r"([0-9.]+)([kMG])", value) if isinstance(value, str) else None
    example = f", as in {power[1]}e{_POWERS[power[2]]}" if power else ""
    raise ConfigError(f"{key} is {show(value)}: give {describe(hint)}{example}.")


def _convert(hint: object, value: object) -> object:
    """Converts to one type, or raises an error for `convert_single` to explain."""
    if typing.get_origin(hint) is Literal:
        if isinstance(value, str) and value in typing.get_args(hint):
            return value
    elif is_range(hint):
        kinds = typing.get_args(hint)
        if isinstance(value, list | tuple) and len(value) == len(kinds):
            return tuple(map(_number, kinds, value))
    elif hint is int or hint is float:
        return _number(hint, value)
    elif isinstance(hint, type) and isinstance(value, hint) and value != "":
        return value
    raise TypeError


def _number(kind: type[int] | type[float], value: object) -> int | float:
    """Converts a value to a finite number. True and false do not count as numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    number = kind(value)  # for integers, this raises an error if the value is nan or infinity
    if number != value if kind is int else not math.isfinite(number):
        raise ValueError
    return number


def check_text(key: str, text: str) -> None:
    """Refuses text that cannot be a path or name, before the text is used.

    Args:
      key: name of the setting in messages.
      text: a path or a name, or several of them separated by commas.

    Raises:
      ConfigError: if the text is not valid Unicode, or has a control character or too long a name.
    """
    # "Cc" are control characters. "Cs" are halves of letters, which UTF-8 cannot hold.
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in text):
        raise ConfigError(f"{key} is {show(text)}: give UTF-8 text without control characters.")
    longest = max(map(len, re.split(b"[/,]", text.encode())))
    if longest > _MOST_NAME:
        raise ConfigError(
            f"{key} is {show(text)}: shorten the name of {longest} bytes to at most {_MOST_NAME}."
        )


def describe(hint: object, bounds: str = "") -> str:
    """Describes a type in words, with the bounds of its numbers if given."""
    words = []
    for option in options(hint):
        inner = typing.get_args(option)
        if is_list(option):
            example = f", as in {_LISTS[inner[0]]}{bounds}" if inner[0] in _LISTS else ""
            if typing.get_origin(inner[0]) is Literal:
                example = f", as in [{','.join(typing.get_args(inner[0])[:2])}]"
            words.append(f"a list{example}")
        elif typing.get_origin(option) is dict:
            words.append("values by name")
        elif typing.get_origin(option) is Literal:
            words += inner
        elif is_range(option):
            whole, count = "whole " if inner[0] is int else "", len(inner)
            start = "a range [low,high] of" if count == 2 else f"{count}"
            words.append(f"{start} {whole}numbers{bounds}")
        else:
            words.append(_NAMES[option] + (bounds if option in (int, float) else ""))
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def show(value: object, quote: str = "'") -> str:
    """Formats a value as a user would type it, and shortens long text.

    Args:
      value: plain data.
      quote: the quotation mark around text.
    """
    if isinstance(value, str):
        text = value[:_SHOWN]
        text = text if text.isprintable() else text.encode("unicode_escape").decode("ascii")
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
