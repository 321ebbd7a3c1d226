"""Numbers in the lines that commands print: counts with their noun, and durations."""


def count(number: int, noun: str, plural: str | None = None) -> str:
    """Writes how many there are.

    Args:
      number: of things.
      noun: one of them.
      plural: several of them; None adds an s.

    Returns:
      `1 arena` or `1,024 arenas`.
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def duration(seconds: float) -> str:
    """Writes a time: seconds to three digits, however few they are, or minutes and seconds."""
    if seconds < 59.95:  # which three digits round to a minute
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60:,} h {minutes % 60:02d} min"
