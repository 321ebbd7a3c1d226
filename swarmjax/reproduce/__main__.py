"""`python -m swarmjax.reproduce`: the published experiment with seeds and intervals, and a report.

Trains every arm, evaluates its policies and writes the report. `minutes` or Ctrl-C stops it and
saves everything computed so far. `resume=DIR` continues.
"""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import jax
from rich.console import Console
from rich.progress import Progress

from swarmjax import command, provenance
from swarmjax.config import ConfigError, section, to_dict
from swarmjax.exit_codes import FAILED
from swarmjax.outputs import replacing
from swarmjax.report import rows as report_rows
from swarmjax.reproduce import arms, judge
from swarmjax.reproduce import page as reproduce_page
from swarmjax.reproduce.config import ReproduceConfig, load_reproduce
from swarmjax.reproduce.judge import Task
from swarmjax.reproduce.rows import EVALUATION, FACTS, FORMAT
from swarmjax.run.checkpoint import CheckpointError
from swarmjax.run.errors import TrainingError
from swarmjax.run.policy_export import POLICY
from swarmjax.run.signals import Stop, StoppedError

_PLATFORMS = {"cpu": "cpu", "gpu": "cuda,cpu"}  # as JAX calls them


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    began = time.monotonic()
    given, out = _settings(arguments)
    _choose_device(given.device)
    made = [arms.settings(given, arm, out) for arm in given.arms]
    _write(out, given)
    until = began + 60.0 * (given.minutes or float("inf"))
    with Stop(until) as stop:
        for arm, settings in zip(given.arms, made, strict=True):
            if stop.asked:
                break
            if arm in arms.summaries(out):
                continue
            try:
                arms.run(settings, stop)
            except TrainingError as error:
                sys.stderr.write(f"swarmjax.reproduce: error: {arm}: {error}\n")
                return FAILED
            except StoppedError:
                break
            _write(out, given)
    missing = set(given.arms) - arms.summaries(out).keys()
    if stop.asked:
        sys.stdout.write(_stopped(out, given, len(missing)))
        return stop.code or 0
    _judge(out, given)
    page = reproduce_page.write(out)
    sys.stdout.write(f"done; the report is {page}\n")
    return 0


def _settings(arguments: Sequence[str]) -> tuple[ReproduceConfig, Path]:
    """Reads the command line; with `resume=`, applies allowed changes to the stored config."""
    words = {key: value for key, _, value in (word.partition("=") for word in arguments)}
    resumed = words.get("resume", "null").strip("'\"")
    if resumed in ("", "null"):
        given = load_reproduce(arguments)
        name = f"{datetime.now():%Y%m%d-%H%M%S}-reproduce"
        out = Path(given.out) if given.out else Path("runs") / name
        if (out / FACTS).exists():
            raise ConfigError(
                f"out is {out}, which holds a reproduction already: give another directory, or "
                f"resume={out} to go on with it."
            )
        if out.is_dir() and any(out.iterdir()):
            raise ConfigError(f"out is {out}, which is not empty: give a new or an empty folder.")
        return given, out
    out = Path(resumed)
    return load_reproduce(arguments, _read(out)), out


def _read(out: Path) -> dict:
    """Reads the settings of a reproduction that is to be continued."""
    path = out / FACTS
    section.check_text("resume", str(out))
    if not path.exists():
        raise ConfigError(f"resume is {out}, which is not a reproduction: it has no {FACTS}.")
    settings = report_rows.read_object(path).get("settings")
    if not isinstance(settings, dict):
        raise ConfigError(f"{path} has no settings: it is damaged.")
    return settings


def _choose_device(device: str) -> None:
    """Selects the device for JAX, before JAX chooses one itself.

    Raises:
      ConfigError: if there is no such device.
    """
    if device == "auto":
        jax.devices()  # fails here, before anything is written, if JAX_PLATFORMS is wrong
        return
    jax.config.update("jax_platforms", _PLATFORMS[device])
    try:
        found = jax.default_backend()
    except RuntimeError:
        found = None
    if found != device:
        raise ConfigError(
            f"device is {device}, but JAX finds no {device.upper()} here: give auto or "
            f"{'cpu' if device == 'gpu' else 'gpu'}."
        )


def _write(out: Path, given: ReproduceConfig) -> None:
    """Writes the facts of the work done so far."""
    done = arms.summaries(out)
    facts = {
        "format": FORMAT,
        "settings": to_dict(replace(given, resume=None)),
        "seeds": list(range(given.seed, given.seed + given.seeds)),
        "budget": given.budget,
        "fine_tune": given.fine_tune,
        "device": {arm: summary["device"] for arm, summary in done.items()},
        "versions": provenance.versions(),
        "commit": {arm: summary["commit"] for arm, summary in done.items()},
        "seconds": {arm: summary["train_s"] for arm, summary in done.items()},
        "compile_s": {arm: summary["compile_s"] for arm, summary in done.items()},
    }
    _replace(out / FACTS, facts)


def _replace(path: Path, found: dict) -> None:
    """Writes a JSON file completely or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(found, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror or error}.") from None


def _judge(out: Path, given: ReproduceConfig) -> None:
    """Judges the arms that have not been judged yet on this number of episodes."""
    rows = [row for row in judge.read(out) if row["episodes"] == given.episodes]
    known = {(row["arm"], row["seed"], row["stage"]) for row in rows}
    tasks = [task for task in _tasks(out, given) if (task.arm, task.seed, task.stage) not in known]
    progress = Progress(console=Console(stderr=True), transient=True)
    progress.disable = not progress.console.is_terminal
    with progress:
        bar = progress.add_task("policies judged", total=len(tasks))
        rows += judge.judge(given, tasks, lambda: progress.advance(bar))
    _replace(out / EVALUATION, {"format": FORMAT, "rows": rows})


def _tasks(out: Path, given: ReproduceConfig) -> list[Task]:
    """Lists the judging tasks of the arms that are done."""
    return [
        Task(arm, seed, out / arm / POLICY.replace(".", f"-seed{seed}."), stage)
        for arm, summary in arms.summaries(out).items()
        for seed in summary["seeds"]
        for stage in judge.STAGES
    ]


def _stopped(out: Path, given: ReproduceConfig, missing: int) -> str:
    """Writes how to continue."""
    what = f"{missing} of {len(given.arms)} arms to train" if missing else "all arms trained"
    return f"stopped with {what}, saved; go on with: python -m swarmjax.reproduce resume={out}\n"


if __name__ == "__main__":
    sys.exit(command.run("reproduce", main, ReproduceConfig, (CheckpointError,)))
