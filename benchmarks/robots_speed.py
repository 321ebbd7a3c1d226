"""How fast are larger swarms? Times simulation and training with 1 to 50 robots per arena.

`python -m benchmarks.robots_speed robots=1,5,50 [total=327680] [key=value ...]` takes the keys of
`swarmjax.train` except `arenas`. For each number of robots per arena it prints the lines of
`benchmarks.steps_per_second` under the names `robots_speed.*`. The total number of robots is about
the same for all sizes: the number of arenas is the nearest power of two. Each robot has the same
floor area as on stage s6, but the side of an arena is at least 0.8 m. Every arena has three
obstacles. Each program is compiled for exactly its number of robots.
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

from benchmarks import key_value, steps_per_second
from swarmjax import command
from swarmjax.config import Section, about
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig

_ROBOTS, _SIDE = 5, 1.2  # robots and side (m) of stage s6
_LEAST = 0.8  # m; the three obstacles need an arena with at least this side


@dataclass(frozen=True, kw_only=True)
class RobotsConfig(Section):
    """Settings: which swarms to measure."""

    robots: tuple[int, ...] = field(
        default=(1, 2, 3, 5, 10, 20, 50), metadata=about("robots per arena", 1, 50)
    )
    total: int = field(default=327_680, metadata=about("approximate total of robots", 8, 10**8))


def load(robots: int, total: int, words: Sequence[str]) -> TrainConfig:
    """Makes the training config for one number of robots.

    Args:
      robots: robots per arena.
      total: approximate number of robots in all arenas together.
      words: `key=value` arguments for training.

    Returns:
      The config.

    Raises:
      ConfigError: if an argument is invalid.
    """
    side = max(_LEAST, round(_SIDE * math.sqrt(robots / _ROBOTS), 2))
    arenas = max(8, 2 ** round(math.log2(total / robots)))
    size = [f"sim.max_robots={robots}", f"stage.robots={robots}", f"stage.side={side}"]
    return load_train(["stage=s6", "budget=1e10", *words, *size, f"arenas={arenas}"])


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given, words = key_value.parse(RobotsConfig, arguments)
    points = [load(robots, given.total, words) for robots in given.robots]
    for lines in steps_per_second.sweep(points):
        for line in lines:
            name = line["benchmark"].replace("steps_per_second", "robots_speed")
            sys.stdout.write(json.dumps(line | {"benchmark": name}) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("robots_speed", main, RobotsConfig))
