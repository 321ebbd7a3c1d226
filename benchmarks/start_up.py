"""How many seconds pass from the command to the first update, with cold and with warm caches?

`python -m benchmarks.start_up [warm=5] [key=value ...]` takes the keys of `swarmjax.train`. It runs
`swarmjax.train` in separate processes: once with empty caches of XLA and Warp, then `warm` times
with the caches that the first run filled. It prints a JSON line for cold caches and another line
for warm caches, each with the median over its runs. The clock starts before Python starts and stops
when the metrics of the first update are on the disk.
"""

import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks import key_value, peers, steps_per_second
from benchmarks.watched_run import MADE_WITH, Watched
from swarmjax import command
from swarmjax.config import Section, about
from swarmjax.report.rows import Row
from swarmjax.run.load_settings import load_train

_FIRST = ("run.chunk=1", "run.stop_after=1")


@dataclass(frozen=True, kw_only=True)
class StartConfig(Section):
    """Settings: how often to measure."""

    warm: int = field(default=5, metadata=about("runs with warm caches", 1, 100))


def caches(folder: Path) -> dict[str, str]:
    """Returns environment variables that cache all programs, even small ones, in a folder."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str(folder / "xla"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "xla_gpu_per_fusion_autotune_cache_dir",
        "WARP_CACHE_PATH": str(folder / "warp"),
    }


def measure(words: Sequence[str], run: Path, environment: dict[str, str]) -> tuple[float, Row]:
    """Runs training up to the first update.

    Args:
      words: `key=value` arguments for training.
      run: directory of the run.
      environment: environment variables of the run.

    Returns:
      Seconds from the command to the first update, and the run's summary.
    """
    watched = Watched([*words, *_FIRST], run, environment)
    first = [seconds for seconds, _ in watched.rows()]
    return first[0], watched.summary()


def results(given: StartConfig, words: Sequence[str]) -> Iterator[Row]:
    """Measures starts with cold caches and with warm caches; yields a JSON line for each."""
    trained = load_train(words)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for cache, count in {"cold": 1, "warm": given.warm}.items():
            runs = [measure(words, folder / f"{cache}{i}", caches(folder)) for i in range(count)]
            seconds, summaries = zip(*runs, strict=True)
            yield {
                "benchmark": "start_up",
                "cache": cache,
                "seconds": statistics.median(seconds),
                "compile_s": statistics.median(each["compile_s"] for each in summaries),
                "runs_s": list(seconds),
                **steps_per_second.about(trained, summaries[0]["impl"]),
                **{key: summaries[0][key] for key in MADE_WITH},
            }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given, words = key_value.parse(StartConfig, arguments)
    peers.write(results(given, words))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("start_up", main, StartConfig))
