"""Inserts generated parts into pages of docs/, between two markers."""

from swarmjax.config import ConfigError


def insert(text: str, page: str, marker: str, part: str) -> str:
    """Puts text between the markers `<!-- marker -->` and `<!-- /marker -->` of a page.

    Args:
      text: text of the whole page.
      page: name of the page, for error messages.
      marker: the word inside both markers.
      part: text to put between the markers.

    Returns:
      The new text of the page.

    Raises:
      ConfigError: if a marker is missing, or the end marker comes before the begin marker.
    """
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    before, begun, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if not (begun and ended):
        raise ConfigError(f"{page} has no place for the table: give it {begin} and {end}.")
    return f"{before}{begin}\n\n{part}\n{end}{after}"
