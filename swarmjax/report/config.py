"""The settings of a report."""

from dataclasses import dataclass, field
from typing import ClassVar

from swarmjax.config import ConfigError, Section, about
from swarmjax.outputs import OVERWRITE


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Section):
    """Settings: the run to draw or the runs to compare, and where to write the report."""

    command: ClassVar[str] = "report"

    run: str | None = field(default=None, metadata=about("run directory"))
    runs: str | None = field(
        default=None,
        metadata=about(
            "instead of run: run directories, folders of runs (an array, a sweep) and patterns, "
            "separated by commas; makes a table with one line for all runs of the same settings"
        ),
    )
    out: str | None = field(
        default=None,
        metadata=about("directory; null: <run>/report, or with runs only the printed table"),
    )
    overwrite: bool = field(default=False, metadata=OVERWRITE)

    def _check(self) -> None:
        if (self.run is None) == (self.runs is None):
            both = "is missing" if self.run is None else "and runs are given"
            raise ConfigError(f"run {both}: give run=DIR, or runs=DIR,DIR,... for a table.")
