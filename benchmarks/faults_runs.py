"""Campaigns of `benchmarks.faults` against whole runs: kills, signals, and damaged checkpoints.

Every trial is a function that takes a seed and an empty folder, and returns the entries of its
line. The runs are small: 900 updates of four arenas, with a checkpoint after each tenth of the
budget. Each run is compared with an undisturbed run.
"""

import contextlib
import functools
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmjax.exit_codes import INTERRUPTED, REQUEUE
from swarmjax.policy import digest
from swarmjax.run import checkpoint, directory
from swarmjax.run.errors import CheckpointError

UPDATES = 900
WORDS = (
    "stage=s1",
    "arenas=4",
    f"budget={16 * UPDATES}",
    "task.step_limit=8",
    "algo.rollout_length=4",
    "algo.num_minibatches=2",
    "algo.hidden_sizes=[8]",
    "run.tensorboard=false",
    "run.chunk=10",
    "resume=auto",
)
INTERVAL = UPDATES // 10  # updates between two checkpoints
KILLS = 4  # kills of a run before the run may end
_POLL = 0.002  # s


def train_command(run: Path) -> list[str]:
    """Returns the command line that starts or resumes a run."""
    return [sys.executable, "-m", "swarmjax.train", *WORDS, f"run.dir={run}"]


def start(run: Path) -> subprocess.Popen[str]:
    """Starts or resumes a run in its own process."""
    return subprocess.Popen(
        train_command(run), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


class Undisturbed(NamedTuple):
    """An undisturbed run.

    Attributes:
      digest: Digest of the last state.
      begins_s: Seconds from the start until the run logs its first update.
      ends_s: Seconds from the start until the process ends.
    """

    digest: str
    begins_s: float
    ends_s: float


@functools.cache
def undisturbed() -> Undisturbed:
    """Trains a run without a disturbance; its times include the effect of the machine's load."""
    with tempfile.TemporaryDirectory() as folder:
        run, began = Path(folder) / "run", time.monotonic()
        process = start(run)
        _wait_for_updates(process, run)
        begins = time.monotonic() - began
        said, _ = process.communicate()
        ends, found = time.monotonic() - began, checkpoint.find(run)
        assert found.update == UPDATES, said
        return Undisturbed(digest(found.leaves), begins, ends)


def _wait_for_updates(process: subprocess.Popen[str], run: Path) -> None:
    """Waits until a run ends or its log grows; a resumed run first makes its log shorter."""
    before = now = _size(run / directory.METRICS)
    while process.poll() is None and now <= before:
        time.sleep(_POLL)
        before, now = now, _size(run / directory.METRICS)


def _size(file: Path) -> int:
    """Returns the size of a file in bytes; 0 if the file does not exist."""
    return file.stat().st_size if file.exists() else 0


def newest(run: Path) -> int:
    """Returns the update of the newest complete checkpoint; 0 if there is no checkpoint."""
    return max(checkpoint.steps(run), default=0)


def logged(run: Path) -> list[int]:
    """Lists the updates in the metrics, in order; skips a line that was cut off."""
    log = run / directory.METRICS
    whole = log.read_bytes().rfind(b"\n") + 1 if log.exists() else 0
    return [row["update"] for row in directory.read_rows(log, whole)]


def kills(seed: int, folder: Path) -> dict[str, Any]:
    """Kills a run `KILLS` times, then resumes it until it ends.

    One kill comes at a random moment, one during training, one while the run writes a checkpoint,
    and one within the first second after a resume.
    """
    undisturbed()  # called before the first start, since the uncached call takes as long as a run
    random, run = np.random.default_rng(seed), folder / "run"
    moments, repeated = [], []
    for number in range(KILLS):
        how = ("any", "save", "training", "resume")[number % 4]
        process = start(run)
        _MOMENTS[how](process, run, random)
        if process.poll() is None:  # otherwise the run ended before the kill
            moments.append(how)
        process.kill()
        process.communicate()
        rows = [update for update in logged(run) if update >= newest(run)]
        repeated.append(len(rows))
    said, _ = (process := start(run)).communicate()
    whole = is_whole(run)
    sound = process.returncode == 0 and whole["identical"] and whole["log_complete"]
    return {
        "outcome": "ok" if sound else "WRONG",
        "kills": len(moments),
        "moments": moments,
        "repeated_updates": max(repeated),
        "interval": INTERVAL,
        **whole,
        **({} if sound else {"said": said[-500:]}),
    }


def _at_any_moment(process: subprocess.Popen[str], _: Path, random: np.random.Generator) -> None:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(random.uniform(0.0, undisturbed().ends_s))


def _while_training(process: subprocess.Popen[str], run: Path, random: np.random.Generator) -> None:
    """Waits for the first logged update, then at most an undisturbed run's training time."""
    _wait_for_updates(process, run)
    known = undisturbed()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(random.uniform(0.0, known.ends_s - known.begins_s))


def _while_saving(process: subprocess.Popen[str], run: Path, random: np.random.Generator) -> None:
    """Waits until the run writes one of its next three checkpoints, then at most 0.05 s longer."""
    left = int(random.integers(1, 4))
    seen: set[str] = set()
    while left and process.poll() is None:
        names = {path.name for path in (run / checkpoint.FOLDER).glob("*tmp*")} - seen
        seen |= names
        left -= bool(names)
        time.sleep(_POLL)
    time.sleep(random.uniform(0.0, 0.05))


def _in_the_first_second(
    process: subprocess.Popen[str], run: Path, random: np.random.Generator
) -> None:
    """Waits until the process holds the lock of its run, then at most one second longer."""
    while process.poll() is None:
        with contextlib.suppress(OSError):
            if str(process.pid) in (run / directory.LOCK).read_text():
                break
        time.sleep(_POLL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(random.uniform(0.0, 1.0))


_MOMENTS: dict[str, Callable[[subprocess.Popen[str], Path, np.random.Generator], None]] = {
    "any": _at_any_moment,
    "training": _while_training,
    "save": _while_saving,
    "resume": _in_the_first_second,
}


def is_whole(run: Path) -> dict[str, bool]:
    """Checks that a finished run has an undisturbed run's last state and a complete log."""
    with contextlib.suppress(CheckpointError, OSError, ValueError, KeyError):
        summary = json.loads((run / directory.SUMMARY).read_text())
        found = checkpoint.find(run)
        return {
            "identical": found.update == UPDATES and digest(found.leaves) == undisturbed().digest,
            "log_complete": logged(run) == list(range(UPDATES)) and summary["updates"] == UPDATES,
        }
    return {"identical": False, "log_complete": False}


def terms(seed: int, folder: Path) -> dict[str, Any]:
    """Sends a run a signal to stop, as a scheduler does; then resumes the run until it ends.

    Two of three runs get the signal while they train. The other runs get the signal at a random
    moment, mostly while Python starts or while the program is compiled.
    """
    undisturbed()  # called before the run starts, since the uncached call takes as long as a run
    random, run = np.random.default_rng(seed), folder / "run"
    number = (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)[seed % 3]
    moment = "any" if seed // 3 % 3 == 0 else "training"
    process = start(run)
    time.sleep(0.1)  # until Python handles signals; an earlier signal would end any program
    _MOMENTS[moment](process, run, random)
    ended = process.poll() is not None
    process.send_signal(number)
    said, _ = process.communicate()
    wanted = 0 if ended else INTERRUPTED if number == signal.SIGINT else REQUEUE
    # The run may spend its budget before it notices the signal.
    done = newest(run)
    code_is_right = process.returncode in ({wanted, 0} if done == UPDATES else {wanted})
    repeated = len([update for update in logged(run) if update >= done])
    start(run).communicate()
    whole = is_whole(run)
    sound = code_is_right and not repeated and whole["identical"] and whole["log_complete"]
    return {
        "outcome": "ok" if sound else "WRONG",
        "signal": signal.Signals(number).name,
        "moment": moment,
        "code": process.returncode,
        "update": done,
        "repeated_updates": repeated,
        **whole,
        **({} if sound else {"said": said[-500:]}),
    }


# Damaged checkpoints


_KEEP_FIVE = """
import sys
from swarmjax import train
from swarmjax.run import checkpoint
checkpoint.KEPT = 5
sys.exit(train.main(sys.argv[1:]))
"""


@functools.cache
def _template() -> Path:
    """Trains and keeps three runs with several checkpoints each; two of the runs share a config."""
    folder = Path(tempfile.mkdtemp(prefix="faults-"))
    for name, changed in (("mine", ()), ("twin", ()), ("other", ("algo.discount=0.9",))):
        words = [*WORDS, *changed, f"run.dir={folder / name}"]
        subprocess.run([sys.executable, "-c", _KEEP_FIVE, *words], check=True, capture_output=True)
    return folder


def checkpoints(seed: int, folder: Path) -> dict[str, Any]:
    """Damages checkpoints of a run, and checks that the newest intact checkpoint is found."""
    random, run = np.random.default_rng(seed), folder / "mine"
    shutil.copytree(_template() / "mine", run)
    sound = {step: _digest_of(run, step) for step in checkpoint.steps(run)}
    kind = list(_DAMAGES)[seed % len(_DAMAGES)]
    touched = _DAMAGES[kind](run, random)
    left = max((step for step in sound if step not in touched), default=None)
    began = time.perf_counter()
    try:
        kept = checkpoint.find(run)
        found: int | str = kept.update
        # Damage without effect is no error, for example damage to a file that is never read.
        wrong = sound.get(kept.update) != digest(kept.leaves) or (
            left is not None and kept.update < left
        )
    except CheckpointError as error:
        found, wrong = str(error)[:200], left is not None or "\n" in str(error)
    return {
        "outcome": "WRONG" if wrong else "ok",
        "kind": kind,
        "damaged": sorted(touched),
        "newest_untouched": left,
        "found": found,
        "seconds": round(time.perf_counter() - began, 3),
    }


def _digest_of(run: Path, step: int) -> str:
    return digest(checkpoint.find(run, step).leaves)


Damage = Callable[[Path, np.random.Generator], object]


def _newest(damage: Damage, run: Path, random: np.random.Generator) -> set[int]:
    """Damages a file of the newest checkpoints: of one, two or three of them."""
    steps = checkpoint.steps(run)[: int(random.integers(1, 4))]
    for step in steps:
        files = sorted(p for p in checkpoint.path_of(run, step).rglob("*") if p.is_file())
        damage(files[random.integers(len(files))], random)
    return set(steps)


def _flip(file: Path, random: np.random.Generator) -> None:
    """Flips one bit of a file."""
    content = bytearray(file.read_bytes())
    content[random.integers(len(content))] ^= 1 << int(random.integers(8))
    file.write_bytes(content)


def _cut(file: Path, random: np.random.Generator) -> None:
    """Truncates a file."""
    content = file.read_bytes()
    file.write_bytes(content[: random.integers(len(content) + 1)])


def _delete(file: Path, _: np.random.Generator) -> None:
    """Deletes a file."""
    file.unlink()


def _swap(run: Path, random: np.random.Generator) -> set[int]:
    """Swaps two checkpoints."""
    steps = random.choice(checkpoint.steps(run), 2, replace=False)
    first, second = (checkpoint.path_of(run, step) for step in steps)
    aside = run / checkpoint.FOLDER / "aside"
    first.rename(aside)
    second.rename(first)
    aside.rename(second)
    return set(map(int, steps))


def _rename(run: Path, random: np.random.Generator) -> set[int]:
    """Gives a checkpoint the name of another update."""
    step = int(random.choice(checkpoint.steps(run)))
    new = int(random.integers(1, 10 * UPDATES))
    if not checkpoint.path_of(run, new).exists():
        checkpoint.path_of(run, step).rename(checkpoint.path_of(run, new))
    return {step, new}


def _foreign(source: str, run: Path, random: np.random.Generator) -> set[int]:
    """Replaces a checkpoint with the checkpoint of the same update from another run."""
    step = int(random.choice(checkpoint.steps(run)))
    given = checkpoint.path_of(_template() / source, step)
    if given.exists():
        shutil.rmtree(checkpoint.path_of(run, step))
        shutil.copytree(given, checkpoint.path_of(run, step))
        return {step}
    return set()


def _mix(run: Path, random: np.random.Generator) -> set[int]:
    """Combines the arrays of one checkpoint with the metadata of another checkpoint."""
    first, second = map(int, random.choice(checkpoint.steps(run), 2, replace=False))
    to, of = (checkpoint.path_of(run, step) for step in (first, second))
    shutil.rmtree(to / "state")
    shutil.copytree(of / "state", to / "state")
    return {first}


def _config(run: Path, _: np.random.Generator) -> set[int]:
    """Replaces the run's config with the config of another run."""
    shutil.copy(_template() / "other" / directory.CONFIG, run / directory.CONFIG)
    return set(checkpoint.steps(run))


_DAMAGES: dict[str, Callable[[Path, np.random.Generator], set[int]]] = {
    "flip": functools.partial(_newest, _flip),
    "cut": functools.partial(_newest, _cut),
    "delete": functools.partial(_newest, _delete),
    "swap": _swap,
    "rename": _rename,
    "twin": functools.partial(_foreign, "twin"),
    "other": functools.partial(_foreign, "other"),
    "mix": _mix,
    "config": _config,
}
