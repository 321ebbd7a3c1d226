"""Turns the settings of a run or policy into `key=value` words, for a command that continues it.

The command puts these words before the words that the user typed. The last word for a key counts,
so typed words win.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from swarmjax.config import files, section
from swarmjax.config.section import Section


def group_words(
    cls: type[Section], group: str, held: Section, typed: Sequence[str], skip: Iterable[str] = ()
) -> list[str]:
    """Writes a section's values as words, but not those set by a file that the user has chosen.

    Args:
      cls: the command's dataclass.
      group: name of the section in that dataclass, such as `robot`.
      held: the section with the values of the run or policy.
      typed: the words that the user typed. One of them may choose a file for the section.
      skip: keys of the section to leave out.

    Returns:
      A word for each value that differs from its default.
    """
    given = files.parse(cls, typed)
    own = files.read_choice(group, given[group]) if group in given else {}
    left = {*skip, *own.get(group, own)}  # in a file for the whole config, each group is nested
    derived = section.keys(type(held), derived=True)
    return [
        f"{group}.{key}={files.write(value)}"
        for key, value in _differences(held, type(held)()).items()
        if key not in derived and key.partition(".")[0] not in left
    ]


def preset_words(cls: type[Section], group: str, held: Any, typed: Sequence[str]) -> list[str]:
    """Writes a section as words: its preset, and the values that differ from the preset.

    Args:
      cls: the command's dataclass.
      group: name of the section in that dataclass, such as `realism`.
      held: the section with the values of the run or policy. Its `name` is the name of its preset.
      typed: the words that the user typed.

    Returns:
      A word that chooses the preset, and a word for each value that differs from the preset. No
      words if the user has typed a preset.
    """
    if group in files.parse(cls, typed):
        return []
    preset = section.build(type(held), files.read_choice(group, held.name))
    return [f"{group}={held.name}", *files.write_words({group: _differences(held, preset)})]


def preset_of(group: str, held: Section) -> str:
    """Returns the name of the preset whose values a section has; `custom` if no preset has them."""
    derived = section.keys(type(held), derived=True).keys()
    for name in files.choices(group):
        preset = section.build(type(held), files.read_choice(group, name))
        if _differences(held, preset).keys() <= derived:
            return name
    return "custom"


def _differences(held: Section, other: Section) -> dict[str, Any]:
    """Returns, by dotted key, the values that differ from those of another section."""
    mine, its = (files.flatten(section.to_dict(each)) for each in (held, other))
    return {key: value for key, value in mine.items() if key not in its or value != its[key]}
