"""Formats what commands print: counts with their noun, stages' numbers, durations and lines."""

import sys
import textwrap
from collections.abc import Sequence

WIDTH = 120  # letters in a printed line
GLUE = "\0"  # a space at which no line is broken; no path can hold it


def count(number: int, noun: str, plural: str | None = None) -> str:
    """Formats a count with its noun.

    Args:
      number: the count.
      noun: the noun in the singular.
      plural: the noun in the plural; None adds an s.

    Returns:
      Text such as `1 arena` or `1,024 arenas`.
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def setting(value: float | Sequence[float] | None) -> str:
    """Formats a number of a stage: `0.15`, the range `0.1 to 0.2`, or `any` for None."""
    if value is None:
        return "any"
    return " to ".join(f"{end:g}" for end in (value if isinstance(value, Sequence) else [value]))


def duration(seconds: float) -> str:
    """Formats a duration: seconds with three significant digits, minutes and seconds, or hours."""
    if seconds < 59.95:  # larger values would round to 60.0 s
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60:,} h {minutes % 60:02d} min"


def lines(text: str, width: int = WIDTH) -> str:
    """Breaks a text into lines between words.

    Args:
      text: the text. What `GLUE` joins stays on one line.
      width: letters in a line. A longer path has a line of its own. A longer command continues
        after a backslash, as in a shell.
    """
    broken = textwrap.wrap(
        text, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )
    for i, line in enumerate(broken):
        fits = len(line) <= width or "'" in line  # a shell keeps a backslash within quotes
        broken[i] = line.replace(GLUE, " ", -1 if fits else 2).replace(GLUE, " \\\n    ")
    return "\n".join(broken)


def say(text: str, width: int = WIDTH) -> None:
    """Prints a text in lines of at most `width` letters."""
    sys.stdout.write(f"{lines(text, width)}\n")
    sys.stdout.flush()


def shorten(text: str, length: int) -> str:
    """Cuts the beginning off a text, such as a path, that is longer than `length` letters."""
    return text if len(text) <= length else f"...{text[3 - length :]}"
