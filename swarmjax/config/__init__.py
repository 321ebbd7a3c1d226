"""Settings without a subject: the strict converter, and the files of configs/ put together.

`section.py` turns plain data into frozen dataclasses and refuses mistakes in one sentence each;
`files.py` composes the files of configs/ with the words of a command line. Every section of
settings lies in the room that it configures, in its `config.py`. This room imports none of the
others. Start with `section.build`.
"""

from swarmjax.config.section import ConfigError, Section, about, build, show, to_dict

__all__ = ["ConfigError", "Section", "about", "build", "show", "to_dict"]
