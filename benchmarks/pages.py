"""Pages of docs/ that a command writes a part of, between two markers."""

from swarmjax.config import ConfigError


def insert(text: str, page: str, marker: str, part: str) -> str:
    """Puts a part between `<!-- marker -->` and `<!-- /marker -->`.

    Args:
      text: of the whole page.
      page: its name, for an error.
      marker: the word in its markers.
      part: what comes between.

    Returns:
      The new text.

    Raises:
      ConfigError: the page has not both markers, in order.
    """
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    before, begun, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if not (begun and ended):
        raise ConfigError(f"{page} has no place for the table: give it {begin} and {end}.")
    return f"{before}{begin}\n\n{part}\n{end}{after}"
