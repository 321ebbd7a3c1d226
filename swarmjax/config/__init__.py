"""Loads and checks settings: merges files of configs/ with a command line, and converts the result.

`section.py` turns plain data into frozen dataclasses, and refuses each mistake with one sentence.
`values.py` converts and formats single values. `files.py` merges the files of configs/ with the
`key=value` words of a command line. The settings of a package are defined in that package's file
`config.py`. This package imports no other package of the project. Read `section.build` first.
"""

from swarmjax.config.section import Section, about, build, setting, to_dict
from swarmjax.config.values import ConfigError, check_text, show

__all__ = ["ConfigError", "Section", "about", "build", "check_text", "setting", "show", "to_dict"]
