"""The settings of a page that follows a run."""

from dataclasses import dataclass, field
from typing import ClassVar

from swarmjax.config import Section, about, setting


@dataclass(frozen=True, kw_only=True)
class WatchConfig(Section):
    """Settings: which run to follow, and the port of the page."""

    command: ClassVar[str] = "watch"

    run: str = field(metadata=about("run directory"))
    port: int = setting(0, "port of the page, on 127.0.0.1; 0: any free port", 0, 2**16 - 1)
