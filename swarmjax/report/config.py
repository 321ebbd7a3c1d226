"""The settings of a report."""

from dataclasses import dataclass
from typing import ClassVar

from swarmjax.config import ConfigError, Section, setting


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Section):
    """Settings: the run to draw or the runs to compare, and where to write the report."""

    command: ClassVar[str] = "report"

    run: str | None = setting(None, "run directory")
    runs: str | None = setting(
        None,
        "instead of run: run directories, or folders of runs (an array, a sweep), separated by "
        "commas; runs with the same settings form a group; prints a table with a line per group, "
        "and plots the success of all groups in one figure",
    )
    out: str | None = setting(
        None, "directory to write; null: report, in run or beside the first of runs"
    )

    def _check(self) -> None:
        if (self.run is None) == (self.runs is None):
            both = "is missing" if self.run is None else "and runs are given"
            raise ConfigError(f"run {both}: give run=DIR, or runs=DIR,DIR,... to compare.")
