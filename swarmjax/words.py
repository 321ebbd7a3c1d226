"""Formats numbers in the output of commands: counts with their noun, stages' numbers, durations."""

from collections.abc import Sequence


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
