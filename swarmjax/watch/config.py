"""The settings of a page that follows a run."""

from dataclasses import dataclass, field
from typing import ClassVar

from swarmjax.config import Section, about
from swarmjax.config.section import MAX_COUNT


@dataclass(frozen=True, kw_only=True)
class WatchConfig(Section):
    """Which run to follow, on which port, and how to replay its newest policy."""

    command: ClassVar[str] = "watch"

    run: str = field(metadata=about("run directory"))
    port: int = field(
        default=0, metadata=about("port of the page, on 127.0.0.1; 0: any free port", 0, 2**16 - 1)
    )
    seconds: float = field(
        default=30.0, metadata=about("shortest time between two replays, s", 1.0, 1e6)
    )
    level: int = field(default=0, metadata=about("number of the level to replay", 0, 9_999))
    seed: int | None = field(
        default=None,
        metadata=about("seed of the policy to replay; null: the run's first seed", 0, MAX_COUNT),
    )
    extensions: str | None = field(
        default=None,
        metadata=about(
            "Python file with the pieces that the run was trained with; it is executed; "
            "null: a policy that needs such pieces is not replayed"
        ),
    )
