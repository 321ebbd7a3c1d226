"""What does a larger swarm cost? Times the environment and training with 1 to 50 robots per arena.

`python -m benchmarks.robots_speed robots=1,5,50 [total=327680] [key=value ...]` takes the keys of
`swarmjax.train` except `arenas`, and prints the lines of `benchmarks.steps_per_second` for each
size, as `robots_speed.*`. The total number of robots is about the same for all sizes: the number of
arenas is the nearest power of two. Each robot has the same floor area as on s6, in an arena of at
least 0.8 m with three obstacles. Each program is compiled for exactly its number of robots.
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

from benchmarks import key_value, steps_per_second
from swarmjax import command
from swarmjax.config import Section, about
from swarmjax.run.settings import TrainConfig, load_train

_ROBOTS, _SIDE = 5, 1.2  # of s6; m
_LEAST = 0.8  # m; the three obstacles need this side


@dataclass(frozen=True, kw_only=True)
class RobotsConfig(Section):
    """Settings: which swarms to measure."""

    robots: tuple[int, ...] = field(
        default=(1, 2, 3, 5, 10, 20, 50), metadata=about("robots per arena", 1, 50)
    )
    total: int = field(default=327_680, metadata=about("approximate total of robots", 8, 10**8))


def load(robots: int, total: int, words: Sequence[str]) -> TrainConfig:
    """Makes the config of one size.

    Args:
      robots: robots per arena.
      total: approximate total of robots.
      words: `key=value` words for training.

    Returns:
      The config.

    Raises:
      ConfigError: if a word is invalid.
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
