"""How fast does this checkout train compared with another checkout, or with other settings?

`python -m benchmarks.trees_speed [before=FOLDER] [than=key=value] [stage=NAME] [key=value ...]`
takes the keys of `swarmjax.train`, which apply to both sides of the comparison. The first side
trains with the code in the folder `before`, by default this checkout. The second side trains with
the code of this checkout, and with the setting `than` if that is given. Each side is a separate
process. The two processes run alternately, one call each, `PAIRS` times, after warm-up calls. It
prints a JSON line with the median ratio of the second side's speed to the first side's speed, and
with an interval that assumes no distribution.
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
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig

PAIRS = 15
CALL_SECONDS = 0.7  # s; approximate time of a call of either side
# Program of both processes; each process runs it with its checkout as working directory.
_SIDE = """
import sys
from benchmarks.pairs import Arm
from swarmjax.run.load_settings import load_train
arm = Arm(load_train(sys.argv[1:]))
print(arm.compile_s, flush=True)
for line in sys.stdin:
    print(arm.time(int(line)), flush=True)
"""


@dataclass(frozen=True, kw_only=True)
class TreesSpeedConfig(Section):
    """Settings: what to compare."""

    before: str = field(default=".", metadata=about("checkout to compare with this one"))
    than: str | None = field(default=None, metadata=about("setting only for this tree's side"))


class Side:
    """A process that trains with the code of a checkout, on request.

    Attributes:
      compile_s: seconds of compiling.
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
        """Trains for some updates and returns the seconds that this took."""
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
            raise ConfigError("one side ended before it was timed: see its output for the reason.")
        return float(line)


def compare(settings: TreesSpeedConfig, words: Sequence[str]) -> dict[str, Any]:
    """Times both sides alternately.

    Args:
      settings: settings of the two sides.
      words: `key=value` training arguments for both sides.

    Returns:
      The JSON line.

    Raises:
      ConfigError: if one side cannot train.
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
    """Reads a checkout's commit from its file `commit` if there is one, else from git."""
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
