"""The settings of a page that follows a run."""

from dataclasses import dataclass, field
from typing import ClassVar

from swarmjax.config import Section, about
from swarmjax.config.section import MAX_COUNT


@dataclass(frozen=True, kw_only=True)
class WatchConfig(Section):
    """Which run is followed, where, and what is shown of its newest policy."""

    command: ClassVar[str] = "watch"

    run: str = field(metadata=about("run directory"))
    port: int = field(
        default=0, metadata=about("of the page, on 127.0.0.1; 0: any that is free", 0, 2**16 - 1)
    )
    seconds: float = field(
        default=30.0, metadata=about("least time between two replays, s", 1.0, 1e6)
    )
    level: int = field(default=0, metadata=about("number of the level that is replayed", 0, 9_999))
    seed: int | None = field(
        default=None,
        metadata=about("of the policy that is replayed; null: the run's first", 0, MAX_COUNT),
    )
    extensions: str | None = field(
        default=None,
        metadata=about(
            "Python file with the pieces that the run was trained with; it is run. null: a policy "
            "that needs some is not replayed"
        ),
    )
