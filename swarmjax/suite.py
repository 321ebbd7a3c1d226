"""`python -m swarmjax.suite suite=NAME [out=FILE]`: draws the levels of a suite.

The levels are checked against the digests in the suite's file. `write=true` writes new digests into
it.

Examples:
  # draw the levels, and check them against the digests in the suite's file
  python -m swarmjax.suite suite=headline
  # write all levels to a file that evaluate reads
  python -m swarmjax.suite suite=headline out=headline.npz
  # put the digests into a suite of your own
  python -m swarmjax.suite suite=my_suite.yaml write=true
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from swarmjax import command, outputs
from swarmjax.config import ConfigError, about, files, reading, setting
from swarmjax.config.section import Section
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.cells import Cell, Suite
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.suite_config import read_suite
from swarmjax.evaluate.table import PLAIN_WIDTH
from swarmjax.outputs import OVERWRITE, replacing


@dataclass(frozen=True, kw_only=True)
class SuiteConfig(Section):
    """The suite to draw, and the outputs."""

    command: ClassVar[str] = "suite"

    suite: str = field(metadata=about("a name in configs/suites/, or a .yaml file"))
    out: str | None = setting(None, ".npz file for all of its levels")
    overwrite: bool = field(default=False, metadata=OVERWRITE)
    write: bool = setting(False, "write digests into the suite's file")


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(SuiteConfig, arguments)
    if settings.out is not None and Path(settings.out).suffix != ".npz":
        raise ConfigError(f"out is {reading.called(settings.out)}: give a file .npz.")
    out = [] if settings.out is None else [Path(settings.out)]
    outputs.check("out", out, overwrite=settings.overwrite)
    suite = _renew(settings) if settings.write else cells.draw(settings.suite)
    for path in out:
        cells.write(path, suite)
    outputs.note(out)
    console = Console()
    if not console.is_terminal:
        console.width = PLAIN_WIDTH
    _show(console, suite)
    return 0


def _renew(settings: SuiteConfig) -> Suite:
    """Draws a suite without checking its digests, and writes the new digests into its file."""
    file = read_suite(settings.suite)
    suite = Suite(file.name, tuple(map(cells.draw_cell, file.cells)))
    path = files.named_path("suites", settings.suite, "suite")
    content = reading.read_yaml(path)
    for entry, cell in zip(content["cells"], suite.cells, strict=True):
        entry["digest"] = cell.digest
    try:
        with replacing(path) as temporary:
            temporary.write_text(_comment(path) + to_yaml(content))
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror or error}.") from None
    return suite


def _comment(path: Path) -> str:
    """Returns the comment lines at the beginning of a file."""
    lines = reading.read_text(path).splitlines(keepends=True)
    end = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return "".join(lines[:end])


def to_yaml(content: dict[str, Any]) -> str:
    """Formats a suite's file, with a line for each key.

    Args:
      content: plain data, as from `reading.read_yaml`.
    """
    lines = [f"{key}: {_flow(value)}" for key, value in content.items() if key != "cells"]
    lines.append("cells:")
    for cell in content["cells"]:
        first, *others = (f"{key}: {_flow(value)}" for key, value in cell.items())
        lines += [f"  - {first}", *(f"    {line}" for line in others)]
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    """Formats a value on one line, with quotes only around text that YAML could misread."""
    if not isinstance(value, dict):
        return files.write(value)
    return "{" + ", ".join(f"{key}: {_flow(item)}" for key, item in value.items()) + "}"


def _show(console: Console, suite: Suite) -> None:
    """Prints a row for each cell."""
    table = Table(box=box.SIMPLE if console.is_terminal else None)
    heads = (
        "cell",
        "robots",
        "obstacles",
        "side",
        "realism",
        "friction",
        "steps",
        "levels",
        "unreachable",
    )
    for i, head in enumerate((*heads, "digest")):
        table.add_column(head, justify="right" if 0 < i < len(heads) else "left")
    for cell in suite.cells:
        table.add_row(*_row(cell))
    console.print(table)


def _row(cell: Cell) -> list[str]:
    stage = cell.stage
    lost = np.isinf(trials.ways(EvaluateConfig(policy="", stage=stage), cell.levels))
    numbers = (stage.robots, stage.obstacles, f"{'-'.join(f'{x:g}' for x in set(stage.sides))} m")
    friction = "-" if cell.hull_friction is None else f"{cell.hull_friction:g}"
    words = (cell.realism or "-", friction, cell.steps or "-")
    counts = (len(cell.episodes), int(lost.any(axis=-1).sum()))
    return [str(each) for each in (cell.name, *numbers, *words, *counts, cell.digest[:12])]


if __name__ == "__main__":
    sys.exit(command.run("suite", main, SuiteConfig))
