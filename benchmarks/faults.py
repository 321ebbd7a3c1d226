"""Runs campaigns of faults, to test what the commands do when something goes wrong.

`python -m benchmarks.faults campaign=NAME out=FILE [count=N] [seed=S]` tries one fault after the
other and appends a JSON line for each trial to `out`. The command may be stopped at any time. When
it is started again, it runs only the trials that are not yet in `out`. `campaign=table out=FILE`
prints a summary of `out`. A line has the entries `campaign`, `trial`, `seed`, `commit` and
`outcome`, and further entries that depend on the campaign.
"""

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import (
    faults_disk,
    faults_inputs,
    faults_policies,
    faults_runs,
    faults_shared,
    lines,
)
from benchmarks.lines import Line, Output
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about, show
from swarmjax.config.section import MAX_COUNT

Trial = Callable[[int, Path], dict[str, Any]]
TABLE = "table"
_STRIDE = 1_000_000  # maximum number of trials per campaign; each trial has its own seed


class Campaign(NamedTuple):
    """Faults of one kind.

    Attributes:
      trial: function that takes a seed and an empty folder, tries one fault, and returns the
        entries of the trial's line.
      trials: the default number of trials.
    """

    trial: Trial
    trials: int


CAMPAIGNS: dict[str, Campaign] = {
    "kills": Campaign(faults_runs.kills, 50),  # each trial kills a run four times
    "terms": Campaign(faults_runs.terms, 50),
    "checkpoints": Campaign(faults_runs.checkpoints, 2000),
    "disk": Campaign(faults_disk.trial, 40),
    "nan": Campaign(faults_disk.spoil, 240),
    "policies": Campaign(faults_policies.trial, 1000),
    "inputs": Campaign(faults_inputs.trial, 5000),
    "shared": Campaign(faults_shared.trial, 2000),
}


@dataclass(frozen=True, kw_only=True)
class FaultsConfig(Section):
    """Settings: which faults to try."""

    campaign: str = field(metadata=about(f"{', '.join(CAMPAIGNS)}; or table, the summary of out"))
    out: str = field(metadata=about("file of the lines; its trials are not tried again"))
    count: int | None = field(
        default=None, metadata=about("number of trials; null: the campaign's default", 1, _STRIDE)
    )
    seed: int = field(
        default=0, metadata=about("seed of the faults; each seed tries other faults", 0, MAX_COUNT)
    )

    def _check(self) -> None:
        if self.campaign not in (*CAMPAIGNS, TABLE):
            names = ", ".join((*CAMPAIGNS, TABLE))
            raise ConfigError(f"campaign is {show(self.campaign)}: give one of {names}.")


def run(settings: FaultsConfig) -> Iterator[Line]:
    """Runs the trials that are not yet in the file, and yields each line once it is written.

    Args:
      settings: the campaign's settings.
    """
    output, campaign = Output(Path(settings.out)), CAMPAIGNS[settings.campaign]
    asked = (settings.campaign, settings.seed)
    done = {row["trial"] for row in output.lines if (row["campaign"], row["seed"]) == asked}
    commit = provenance.commit()
    for number in range(campaign.trials if settings.count is None else settings.count):
        if number in done:
            continue
        with tempfile.TemporaryDirectory(prefix="faults-") as folder:
            told = campaign.trial(settings.seed * _STRIDE + number, Path(folder))
        row = {"campaign": asked[0], "trial": number, "seed": asked[1], "commit": commit}
        output.add(row | told)
        yield row | told


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Counts the outcomes of each campaign, and finds the maximum of each number.

    Args:
      rows: the lines of the file.

    Returns:
      A table in Markdown.
    """
    lines = [
        "| campaign | commits | outcome | trials | the most of each number |",
        "|---" * 5 + "|",
    ]
    counted = Counter((row["campaign"], row["outcome"]) for row in rows)
    for (campaign, outcome), count in sorted(counted.items()):
        mine = [row for row in rows if (row["campaign"], row["outcome"]) == (campaign, outcome)]
        commits = ", ".join(sorted({str(row["commit"]) for row in mine}))
        lines.append(f"| {campaign} | {commits} | {outcome} | {count} | {_most(mine)} |")
    return "\n".join(lines)


def _most(rows: Sequence[Mapping[str, Any]]) -> str:
    """Writes the largest value of each number in the rows."""
    found: dict[str, float] = {}
    for row in rows:
        for key, value in row.items():
            if isinstance(value, int | float) and key not in ("trial", "seed"):
                found[key] = max(value, found.get(key, value))
    return ", ".join(f"{key} {value:.4g}" for key, value in found.items())


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = lines.load(FaultsConfig, arguments)
    if settings.campaign != TABLE:
        outcomes = Counter(row["outcome"] for row in run(settings))
        sys.stdout.write(f"tried now: {json.dumps(outcomes)}\n")
    sys.stdout.write(table(lines.read(Path(settings.out))) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("faults", main, FaultsConfig))
