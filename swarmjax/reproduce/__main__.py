"""`python -m swarmjax.reproduce`: the published experiment with seeds and intervals, and a report.

Trains every arm, evaluates its policies and writes the report. `minutes` or Ctrl-C stops it and
saves everything computed so far. `resume=DIR` continues.

Examples:
  # all arms, ten seeds each: hours
  python -m swarmjax.reproduce
  # a first look at two arms, without verdicts
  python -m swarmjax.reproduce seeds=3 budget=100000 'arms=[curriculum,baseline]'
  # stop after 55 minutes, with all saved
  python -m swarmjax.reproduce minutes=55 out=runs/paper
  # go on with a reproduction that was stopped
  python -m swarmjax.reproduce resume=runs/paper
"""

import itertools
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import jax

from swarmjax import command, life, provenance
from swarmjax.config import ConfigError, check_text, files, section, to_dict
from swarmjax.evaluate import trials
from swarmjax.exit_codes import FAILED
from swarmjax.pages import builder
from swarmjax.reproduce import arms, judge, page
from swarmjax.reproduce import rows as reproduce_rows
from swarmjax.reproduce.config import ReproduceConfig
from swarmjax.reproduce.judge import Task
from swarmjax.reproduce.rows import ACTIONS, EVALUATION, EXPANDED, FACTS, FORMAT, LAST
from swarmjax.run.checkpoint import CheckpointError
from swarmjax.run.errors import TrainingError
from swarmjax.run.policy_export import POLICY
from swarmjax.run.signals import Stop, StoppedError


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    began = time.monotonic()
    given, out = _settings(arguments)
    jax.devices()  # fails here, before anything is written, if JAX_PLATFORMS is wrong
    made = {arm: arms.settings(given, arm, out) for arm in given.arms}
    stored = to_dict(replace(given, resume=None))
    _write(out / FACTS, {"settings": stored, "versions": provenance.versions()})
    with Stop(began + 60.0 * (given.minutes or float("inf"))) as stop:
        for arm, settings in made.items():
            if stop.asked:
                break
            if arm in reproduce_rows.summaries(out):
                continue
            try:
                arms.run(settings, stop)
            except TrainingError as error:
                sys.stderr.write(f"swarmjax.reproduce: error: {arm}: {error}\n")
                return FAILED
            except StoppedError:
                break
    if stop.asked:
        missing = len(set(given.arms) - reproduce_rows.summaries(out).keys())
        done = f"{missing} of {len(made)} arms left to train" if missing else "all arms trained"
        again = command.line("reproduce", f"resume={out}")
        sys.stdout.write(f"stopped and saved, with {done}; continue with: {again}\n")
        return stop.code or 0
    _judge(out, given)
    sys.stdout.write(f"done; the report is {page.write(out)}\n")
    return 0


def _settings(arguments: Sequence[str]) -> tuple[ReproduceConfig, Path]:
    """Reads the command line, and with `resume` the settings of the reproduction to continue."""
    given = files.load(ReproduceConfig, arguments)
    if given.resume:
        check_text("resume", given.resume)
        others = files.parse(ReproduceConfig, arguments).keys() - {"resume", "minutes"}
        if others:
            raise ConfigError(f"{min(others)} cannot be given with resume: leave it out.")
        stored = reproduce_rows.read_facts(Path(given.resume))["settings"]
        more = {"resume": given.resume, "minutes": given.minutes}
        return section.build_stored(ReproduceConfig, stored | more, ""), Path(given.resume)
    out = Path(given.out or f"runs/{datetime.now():%Y%m%d-%H%M%S}-reproduce")
    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(
            f"out is {out}, which is not empty: give a new or an empty folder, or resume={out} to "
            "continue the reproduction in it."
        )
    return given, out


def _write(path: Path, content: Mapping[str, Any]) -> None:
    """Writes one of the command's two JSON files."""
    text = json.dumps({"format": FORMAT, **content}, indent=2, allow_nan=False) + "\n"
    builder.write(path.parent, {path.name: text.encode()})


def _judge(out: Path, given: ReproduceConfig) -> None:
    """Evaluates the policies that have not been evaluated yet."""
    rows = reproduce_rows.read_rows(out)
    known = {(row["arm"], row["seed"], row["stage"], row["action"]) for row in rows}
    done = reproduce_rows.summaries(out)
    every = itertools.product(done, range(given.seeds), (LAST, EXPANDED), ACTIONS)
    tasks = [
        Task(arm, seed, out / arm / POLICY.replace(".", f"-seed{seed}."), stage, action)
        for arm, seed, stage, action in every
        if (arm, seed, stage, action) not in known
    ]
    with life.progress("reproduce") as progress:
        bar = progress.add_task("policies evaluated", total=len(tasks))
        for row in trials.work(judge.judge, tasks, min(provenance.cores(), len(tasks))):
            rows.append(row)
            progress.advance(bar)
    _write(out / EVALUATION, {"rows": rows})


if __name__ == "__main__":
    sys.exit(command.run("reproduce", main, ReproduceConfig, (CheckpointError,)))
