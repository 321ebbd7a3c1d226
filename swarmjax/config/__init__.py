"""Loads and checks settings of any kind: a strict converter, and a composer for configs/.

`section.py` turns plain data into frozen dataclasses, and refuses each mistake in one sentence.
`values.py` converts and formats single values. `files.py` composes the files of configs/ with the
words of a command line. Each section of settings lies in `config.py` of the package that the
section configures. This package imports no other package of the project. Start with
`section.build`.
"""

from swarmjax.config.section import Section, about, build, setting, to_dict
from swarmjax.config.values import ConfigError, check_text, show

__all__ = ["ConfigError", "Section", "about", "build", "check_text", "setting", "show", "to_dict"]
