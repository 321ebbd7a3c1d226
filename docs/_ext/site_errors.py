"""Sentences of errors that the program really prints.

    ```{sentence} train stage=s7
    stage is 's7': ...
    ```

runs the command and compares the sentence. One that differs fails the build. Three dots at the end
stand for more.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

_LOG = logging.getLogger(__name__)
_USER_ERROR = 2


class Sentence(SphinxDirective):
    """A command and the sentence with which it is refused."""

    required_arguments = 1
    final_argument_whitespace = True
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Compares the sentence with what the command prints."""
        words = self.arguments[0].split()
        expected = " ".join(" ".join(self.content).split())
        code, printed = refused(words)
        where = (self.env.docname, self.lineno)
        if code != _USER_ERROR or not _agrees(printed, expected):
            told = f"'{' '.join(words)}' ends with {code} and prints: {printed}"
            _LOG.warning("%s", told, location=where, type="site", subtype="sentence")
        shown = f"$ swarmjax {' '.join(words)}\nswarmjax.{words[0]}: error: {expected}"
        return [nodes.literal_block(shown, shown, language="console", classes=["sentence"])]


def _agrees(printed: str, expected: str) -> bool:
    if expected.endswith("..."):
        return printed.startswith(expected.removesuffix("..."))
    return printed == expected


def refused(words: list[str]) -> tuple[int, str]:
    """Runs a command in an empty folder.

    Args:
      words: its name and its arguments.

    Returns:
      The exit code, and the last line on standard error without the command's name.
    """
    module = f"swarmjax.{words[0]}"
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "empty.npz").touch()
        done = subprocess.run(
            [sys.executable, "-m", module, *words[1:]],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
        )
    last = (done.stderr.strip().splitlines() or [""])[-1]
    return done.returncode, last.removeprefix(f"{module}: error: ")


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directive."""
    app.add_directive("sentence", Sentence)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
