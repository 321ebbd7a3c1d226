"""Inserts generated parts into pages of docs/, between two markers."""

from swarmjax.config import ConfigError


def insert(text: str, page: str, marker: str, part: str) -> str:
    """Puts a part between `<!-- marker -->` and `<!-- /marker -->`.

    Args:
      text: text of the whole page.
      page: name of the page, for an error.
      marker: the word in the markers.
      part: text to put between the markers.

    Returns:
      The new text.

    Raises:
      ConfigError: if the page does not have both markers in order.
    """
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    before, begun, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if not (begun and ended):
        raise ConfigError(f"{page} has no place for the table: give it {begin} and {end}.")
    return f"{before}{begin}\n\n{part}\n{end}{after}"
