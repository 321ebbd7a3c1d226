"""How fast does this tree train beside another checkout, or beside itself with other settings?

`python -m benchmarks.trees_speed [before=FOLDER] [than=key=value] [stage=NAME] [key=value ...]`
takes the keys of `swarmjax.train`, for both sides. `before` is a checkout of another commit, this
one by default; `than` is a setting of this tree's side alone. Each side is a process of its own
that waits for the other: a call of each, `PAIRS` times, after one that is not counted. It prints a
JSON line: the median ratio of this tree's speed to that of the other, with an interval that holds
it whatever its distribution.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from benchmarks import key_value, pairs
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about
from swarmjax.run.settings import TrainConfig, load_train

PAIRS = 15
CALL_SECONDS = 0.7  # of either side, about
# What either process runs, in the checkout that is its working directory.
_SIDE = """
import sys
from benchmarks.pairs import Arm
from swarmjax.run.settings import load_train
arm = Arm(load_train(sys.argv[1:]))
print(arm.compile_s, flush=True)
for line in sys.stdin:
    print(arm.time(int(line)), flush=True)
"""


@dataclass(frozen=True, kw_only=True)
class TreesSpeedConfig(Section):
    """What is compared."""

    before: str = field(default=".", metadata=about("checkout that is compared with this one"))
    than: str | None = field(default=None, metadata=about("setting of this tree's side alone"))


class Side:
    """A process that trains in a checkout when it is asked to.

    Attributes:
      compile_s: seconds that compiling took.
    """

    def __init__(self, tree: Path, words: Sequence[str]) -> None:
        paths = [str(tree), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SIDE, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=tree,
            env=os.environ
            | {"PYTHONPATH": os.pathsep.join(paths), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
        )
        self.compile_s = self._read()

    def time(self, updates: int) -> float:
        """Trains for some updates and returns the seconds that took."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{updates}\n")
        self._process.stdin.flush()
        return self._read()

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate()

    def _read(self) -> float:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise ConfigError("one side ended before it was timed: its own words say why.")
        return float(line)


def compare(settings: TreesSpeedConfig, words: Sequence[str]) -> dict[str, Any]:
    """Times both sides in turn.

    Args:
      settings: what is compared.
      words: of both sides.

    Returns:
      A line for JSON.

    Raises:
      ConfigError: if a side cannot be trained.
    """
    load_train([*words, *filter(None, [settings.than])])
    before = Side(Path(settings.before).resolve(), words)
    mine = Side(Path.cwd(), [*words, *filter(None, [settings.than])])
    before.time(2)
    updates = max(2, round(CALL_SECONDS / (before.time(2) / 2)))
    mine.time(updates)
    timed = pairs.in_turn(lambda: before.time(updates), lambda: mine.time(updates), PAIRS)
    before.close()
    mine.close()
    ratio, low, high = pairs.median([theirs / own for theirs, own in timed])
    return {
        "benchmark": "trees_speed",
        "words": list(words),
        "than": settings.than,
        "speed_ratio": ratio,
        "speed_ratio_low": low,
        "speed_ratio_high": high,
        "pairs": PAIRS,
        "updates": updates,
        "seconds": [list(pair) for pair in timed],
        "compile_s": [before.compile_s, mine.compile_s],
        "device": jax.devices()[0].device_kind,
        "versions": provenance.versions(),
        "commits": [_commit(Path(settings.before)), provenance.commit()],
    }


def _commit(tree: Path) -> str | None:
    """Reads the commit of a checkout; of a mere copy, the file `commit` in it."""
    if (tree / "commit").is_file():
        return (tree / "commit").read_text().strip()
    words = ["git", "-C", str(tree), "rev-parse", "--short=12", "HEAD"]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    return found.stdout.strip() or None


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    mine, others = key_value.parse(TreesSpeedConfig, arguments)
    sys.stdout.write(f"{json.dumps(compare(mine, others))}\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("trees_speed", main, TrainConfig))
