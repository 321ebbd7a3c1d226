"""How long does training take from the command to the first update, or to a swarm that succeeds?

`python -m benchmarks.from_command until=update|success [key=value ...]` takes the keys of
`swarmjax.train` and runs `swarmjax.train` in new processes, whose clock starts before Python does.

`until=update` stops the clock when the metrics of the first update are on the disk: once with empty
caches of XLA and Warp, then `warm` times with the caches that the first run filled. It prints a
JSON line for the empty caches and one for the filled caches, each with the median over its runs.

`until=success` trains each seed with the existing caches, and stops as soon as robots on the last
stage reach at least `stop_at` of the targets over a whole cohort of training episodes. The saved
policy is then evaluated in MuJoCo C on the wheeled body. A line has the result, and the seconds
until training measured the shares 0.90 and 0.95 and until the policy was saved. These times include
compilation.
"""

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks import lines, steps_per_second
from swarmjax import command
from swarmjax.config import ConfigError, Section, about
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.exit_codes import INTERRUPTED
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import Row
from swarmjax.run.load_settings import load_train
from swarmjax.run.policy_export import POLICY
from swarmjax.run.recorder import METRICS
from swarmjax.task.stage_files import load_levels

SHARES = (0.90, 0.95)

# Entries of a run's summary that give the device, versions and commit.
MADE_WITH = ("device", "versions", "commit")
_PAUSE = 0.01  # s between two reads of the run's metrics
# Many containers prevent Python from saving its bytecode, so every start takes seconds longer. An
# empty value lets Python save bytecode.
_AS_EVERYWHERE = {"PYTHONDONTWRITEBYTECODE": ""}
_FIRST = ("run.chunk=1", "run.stop_after=1")


@dataclass(frozen=True, kw_only=True)
class FromCommandConfig(Section):
    """Settings: when the clock stops, and how often to measure."""

    until: Literal["update", "success"] = field(metadata=about("when the clock stops"))
    warm: int = field(default=5, metadata=about("runs with warm caches, for update", 1, 100))
    seed: tuple[int, ...] = field(
        default=(0,), metadata=about("seeds, one after the other, for success", 0, MAX_COUNT)
    )
    stop_at: float = field(
        default=0.95, metadata=about("share of targets at which training stops", 0.95, 1.0)
    )
    episodes: int = field(default=500, metadata=about("episodes to judge the policy on", 1, 10**6))


class Watched:
    """A training run in its own process.

    Attributes:
      directory: directory of the run.
      seconds: seconds from the start of the command to its end; valid once the run has ended.
    """

    def __init__(
        self, words: Sequence[str], directory: Path, environment: Mapping[str, str]
    ) -> None:
        """Starts the run.

        Args:
          words: `key=value` arguments for `swarmjax.train`.
          directory: directory for the run; it must not exist.
          environment: environment variables in addition to those of this process.
        """
        self.directory, self.seconds, self._asked = directory, 0.0, False
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115  # `_finish` closes it
        self._began = time.perf_counter()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "swarmjax.train", *words, f"run.dir={directory}"],
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env={**os.environ, **_AS_EVERYWHERE, **environment},
        )

    def rows(self) -> Iterator[tuple[float, dict[str, Any]]]:
        """Yields each row of the metrics and the seconds since the run started, until the run ends.

        Raises:
          ConfigError: if the run ends with an error; the message is the run's last error line.
        """
        path, at = self.directory / METRICS, 0
        while True:
            ended = self._process.poll() is not None
            whole = path.read_text()[at:].rpartition("\n")[0] if path.exists() else ""
            now = time.perf_counter() - self._began
            at += len(whole) + 1 if whole else 0
            yield from ((now, json.loads(text)) for text in whole.splitlines())
            if ended:
                break
            time.sleep(_PAUSE)
        self._finish()

    def stop(self) -> None:
        """Asks the run to save and stop, but only once, since a second signal would kill it.

        `rows` continues until the run has stopped.
        """
        if self._process.poll() is None and not self._asked:
            self._process.send_signal(signal.SIGINT)
            self._asked = True

    def summary(self) -> dict[str, Any]:
        """Reads the run's summary, including device, versions and commit, without using a GPU."""
        return report_rows.read_object(self.directory / report_rows.SUMMARY)

    def _finish(self) -> None:
        self.seconds = time.perf_counter() - self._began
        self._errors.seek(0)
        words = [line.strip() for line in self._errors if line.strip()]
        self._errors.close()
        if self._process.returncode not in (0, INTERRUPTED):
            raise ConfigError(words[-1] if words else f"{self.directory} was not trained.")


# Until the first update


def caches(folder: Path) -> dict[str, str]:
    """Returns environment variables that cache all programs, even small ones, in a folder."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str(folder / "xla"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "xla_gpu_per_fusion_autotune_cache_dir",
        "WARP_CACHE_PATH": str(folder / "warp"),
    }


def first_update(words: Sequence[str], run: Path, environment: dict[str, str]) -> tuple[float, Row]:
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


def starts(given: FromCommandConfig, words: Sequence[str]) -> Iterator[Row]:
    """Measures starts with empty and with filled caches; yields a JSON line for each."""
    trained = load_train(words)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for cache, count in {"cold": 1, "warm": given.warm}.items():
            runs = [
                first_update(words, folder / f"{cache}{i}", caches(folder)) for i in range(count)
            ]
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


# Until success


def train(words: Sequence[str], run: Path, stop_at: float) -> tuple[dict[str, float | None], Row]:
    """Trains until robots on the last stage reach a share of the targets, or the budget is spent.

    Args:
      words: `key=value` words for training.
      run: the run directory.
      stop_at: the share.

    Returns:
      Seconds from the command until the policy was saved, and until each of `SHARES` was measured
      (None for a share that was never measured). Also the last row of the metrics.
    """
    watched, row = Watched(words, run, {}), {}
    found: dict[str, float | None] = dict.fromkeys((f"seconds_to_{x:.2f}" for x in SHARES), None)
    for seconds, row in watched.rows():
        success = row["success_by_stage"][-1] or 0.0
        for share, (name, before) in zip(SHARES, list(found.items()), strict=True):
            if before is None and success >= share:
                found[name] = seconds
        if success >= stop_at:
            watched.stop()
    return found | {"saved_s": watched.seconds}, row


def judge(run: Path, stage: str, episodes: int) -> dict[str, Any]:
    """Evaluates a run's policy on wheels in MuJoCo C; returns share of targets and action mode."""
    path = run / POLICY
    settings = load_levels(
        EvaluateConfig,
        [f"policy={path}", f"stage={stage}", "robot=wheeled", f"episodes={episodes}"],
    )
    policies = trials.read_policies([str(path)])
    (trial,) = trials.run(settings, cells.load(settings).cells, policies)
    judged = float(np.mean(trial.measures["targets_reached"]))
    return {"judged": judged, "action": settings.action}


def successes(given: FromCommandConfig, words: Sequence[str]) -> Iterator[Row]:
    """Trains and evaluates every seed; yields one line per seed."""
    trained = load_train(words)
    for seed in given.seed:
        with tempfile.TemporaryDirectory() as name:
            run = Path(name) / "run"
            found, row = train([*words, f"seed={seed}"], run, given.stop_at)
            summary = report_rows.read_object(run / report_rows.SUMMARY)
            judged = judge(run, trained.stage[-1].name, given.episodes)
        yield {
            "benchmark": "command_to_success",
            "seed": seed,
            "stage": trained.stage_name,
            "stop_at": given.stop_at,
            **found,
            **judged,
            "episodes": given.episodes,
            "measured": row["success_by_stage"][-1],
            "arena_steps": row["arena_steps"],
            "compile_s": summary["compile_s"],
            "train_s": summary["train_s"],
            **steps_per_second.about(trained, summary["impl"]),
            **{key: summary[key] for key in MADE_WITH},
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given, words = lines.parse(FromCommandConfig, arguments)
    lines.write({"update": starts, "success": successes}[given.until](given, words))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("from_command", main, FromCommandConfig))
