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

import json
import re
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from rich import box
from rich.console import Console
from rich.table import Table

from swarmjax import command, outputs
from swarmjax.config import ConfigError, about, files, reading
from swarmjax.config.section import Section
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.cells import Cell, Suite
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.suite_config import read_suite
from swarmjax.evaluate.table import PLAIN_WIDTH
from swarmjax.outputs import OVERWRITE, replacing

_WIDTH = 100  # columns of a suite's file


@dataclass(frozen=True, kw_only=True)
class SuiteConfig(Section):
    """The suite to draw, and the outputs."""

    command: ClassVar[str] = "suite"

    suite: str = field(metadata=about("a name in configs/suites/, or a .yaml file"))
    out: str | None = field(default=None, metadata=about(".npz file for all of its levels"))
    overwrite: bool = field(default=False, metadata=OVERWRITE)
    write: bool = field(
        default=False,
        metadata=about("write digests into the suite's file"),
    )


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
    """Formats a suite's file: a line for each key, with lists of numbers wrapped.

    Args:
      content: Plain data, as from `reading.read_yaml`.

    Returns:
      The text.
    """
    lines = [f"{key}: {_flow(value)}" for key, value in content.items() if key != "cells"]
    lines.append("cells:")
    for cell in content["cells"]:
        for i, (key, value) in enumerate(cell.items()):
            head = f"  {' ' if i else '-'} {key}: "
            lines += textwrap.wrap(
                head + _flow(value),
                _WIDTH,
                subsequent_indent=" " * 6,
                break_long_words=False,
                break_on_hyphens=False,
            )
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    """Formats a value in YAML's flow style; quotes text only where YAML would misread it."""
    if isinstance(value, dict):
        items = (f"{_flow(key)}: {_flow(item)}" for key, item in value.items())
        return "{" + ", ".join(items) + "}"
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z_][\w-]*", value, re.ASCII):
        return value if yaml.safe_load(value) == value else json.dumps(value)
    return json.dumps(value, ensure_ascii=False)


def _show(console: Console, suite: Suite) -> None:
    """Prints a row for each cell."""
    table = Table(box=box.SIMPLE if console.is_terminal else None)
    heads = (
        "cell",
        "robots",
        "obstacles",
        "side",
        "shape",
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
    words = (cell.shape, cell.realism or "-", friction, cell.steps or "-")
    counts = (len(cell.episodes), int(lost.any(axis=-1).sum()))
    return [str(each) for each in (cell.name, *numbers, *words, *counts, cell.digest[:12])]


if __name__ == "__main__":
    sys.exit(command.run("suite", main, SuiteConfig))
