"""The settings of a report."""

from dataclasses import dataclass, field
from typing import ClassVar

from swarmjax.config import Section, about


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Section):
    """Which run is drawn, and where to."""

    command: ClassVar[str] = "report"

    run: str = field(metadata=about("run directory"))
    out: str | None = field(default=None, metadata=about("directory; null: <run>/report"))
