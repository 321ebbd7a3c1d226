"""`python -m swarmjax.suite suite=NAME [out=FILE]`: draws the levels of a suite.

The levels are checked against the digests in the suite's file. A cell without a digest is drawn
unchecked; the command prints the digest to put into the file.

Examples:
  # draw the levels, and check them against the digests in the suite's file
  python -m swarmjax.suite suite=headline
  # write all levels to a file that evaluate reads
  python -m swarmjax.suite suite=headline out=headline.npz
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from swarmjax import command, words
from swarmjax.config import ConfigError, about, files, reading, setting
from swarmjax.config.section import Section
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.config import EvaluateConfig


@dataclass(frozen=True, kw_only=True)
class SuiteConfig(Section):
    """The suite to draw, and the outputs."""

    command: ClassVar[str] = "suite"

    suite: str = field(metadata=about("a name in configs/suites/, or a .yaml file"))
    out: str | None = setting(None, ".npz file for all of its levels")


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(SuiteConfig, arguments)
    if settings.out is not None and Path(settings.out).suffix != ".npz":
        raise ConfigError(f"out is {reading.called(settings.out)}: give a file .npz.")
    suite = cells.draw(settings.suite)
    if settings.out is not None:
        cells.write(Path(settings.out), suite)
    for cell in suite.cells:
        ways = trials.ways(EvaluateConfig(policy="", stage=cell.stage), cell.levels)
        lost = int(np.isinf(ways).any(axis=-1).sum())
        sys.stdout.write(
            f"{cell.name}: {words.count(len(cell.episodes), 'level')}, in {lost} of them a target "
            f"cannot be reached; digest {cell.digest}\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(command.run("suite", main, SuiteConfig))
