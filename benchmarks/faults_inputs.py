"""Fuzzes all commands with mutated command lines, YAML files, runs and policies.

A trial mutates valid words and files. Nine of ten trials run inside this process and only do what a
command does before its work: they make settings and read files. Every tenth trial starts the
command in a separate process, with very little work. Each command must either run, or refuse its
input within ten seconds, in one sentence and with exit code 2. Memory and time are limited.
"""

import contextlib
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from benchmarks import faults_policies
from swarmjax.config import ConfigError, files, section, to_dict
from swarmjax.config.section import Section
from swarmjax.evaluate import cells, trained_settings, trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import list_files
from swarmjax.evaluate.suite_config import read_suite
from swarmjax.export.config import ExportConfig
from swarmjax.policy import PolicyError
from swarmjax.policy_file import read_meta
from swarmjax.replay.config import ReplayConfig
from swarmjax.report import rows, table
from swarmjax.report.config import ReportConfig
from swarmjax.reproduce.config import ReproduceConfig
from swarmjax.run.load_settings import load_run, load_train
from swarmjax.run.settings import TrainConfig

# Seconds of processor time until a refusal; a wall clock would also count the machine's other work.
MOST_SECONDS = 10.0
_MOST_WAITING = 60.0  # s by the wall clock; a trial that takes longer counts as hanging
_MOST_MEMORY = 2**31  # bytes that a trial may take in addition to the memory of this process
_PROCESS_MEMORY = 2**34  # bytes of address space; JAX reserves more than it uses
_PROCESS_SECONDS = 180.0  # s; limit for a separate process, on a machine that does other work
_EVERY = 10  # one of this many trials starts a separate process
_ROOT = Path(__file__).resolve().parents[1]
_ENVIRONMENT = {
    "PYTHONPATH": os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")]),
    "PYTHONDONTWRITEBYTECODE": "1",
    "JAX_PLATFORMS": "cpu",
}
Words = Sequence[str]


# Functions that do only the first part of a command: they make settings and read files


def _train(words: Words) -> None:
    load_run(words)


def _evaluate(words: Words) -> None:
    settings, _ = trained_settings.load(EvaluateConfig, words)
    for text in (settings.policy, settings.compare):
        if text is not None:
            trials.read_policies(list_files("policy", text), settings.extensions)
    if (settings.suite or "").endswith(".npz"):
        cells.read(Path(settings.suite or ""))
    elif settings.suite is not None:
        read_suite(settings.suite)


def _replay(words: Words) -> None:
    settings, _ = trained_settings.load(ReplayConfig, words)
    trials.read_policies(settings.policies, settings.extensions)


def _export(words: Words) -> None:
    settings = files.load(ExportConfig, words)
    if settings.policy is not None:
        read_meta(settings.policy)


def _report(words: Words) -> None:
    settings = files.load(ReportConfig, words)
    if settings.runs is not None:
        table.read(table.find(settings.runs))
    else:
        rows.read(Path(settings.run or ""))


def _reproduce(words: Words) -> None:
    files.load(ReproduceConfig, words)


LOADERS: dict[str, tuple[Callable[[Words], None], type[Section]]] = {
    "train": (_train, TrainConfig),
    "evaluate": (_evaluate, EvaluateConfig),
    "replay": (_replay, ReplayConfig),
    "export": (_export, ExportConfig),
    "report": (_report, ReportConfig),
    "reproduce": (_reproduce, ReproduceConfig),
}
# Valid command lines to mutate; `_write_files` writes their files.
_SOUND: dict[str, list[str]] = {
    "train": ["stage=mine.yaml", "stage=s6 robot=wheeled", "init_from=run", "resume=run", ""],
    "evaluate": [
        "policy=policy.npz",
        "policy=policy.npz suite=suite.yaml",
        "compare=policy.npz,b.npz",
    ],
    "replay": ["policy=policy.npz", "policy=policy.npz suite=suite.yaml worst=1", "policy=b.npz"],
    "export": ["policy=policy.npz out=b.npz", "policy=policy.npz format=c", "run=run"],
    "report": ["run=run", "runs=run", "run=run out=there"],
    "reproduce": ["seeds=3 budget=6000 fine_tune=6000", "arms=[baseline] minutes=1", "resume=run"],
}
# Words that are appended to give a process very little work; the last word for a key counts.
_TINY: dict[str, list[str]] = {
    "train": ["run.stop_after=1", "arenas=8", "algo.rollout_length=2", "task.step_limit=4"],
    "evaluate": ["episodes=1", "steps=2", "workers=1"],
    "replay": ["steps=2", "episodes=1", "workers=1"],
    "reproduce": ["minutes=0.0001"],
    "export": [],
    "report": [],
}
_STAGE = "robots: 2\nside: 1.0\nobstacles: 1\nobstacle_size: 0.1\n"
_SUITE = "cells:\n- name: one\n  stage: s1\n  levels: 2\n  seed: 1000001\n"
_LONG = "9" * 5000
_NUMBERS = ["nan", "inf", "-inf", "1e300", "1e-300", "-1e300", "-1", "0", "1e999999999"]
_NUMBERS += ["2147483648", "9223372036854775808", _LONG, "1" + "0" * 300, "0x" + "f" * 400]
_NASTY = [
    *("", "null", "true", *_NUMBERS, "[", "[1,2]", "[[[[1]]]]", "[" * 3000, "{a:1}", "{a:{a:1}}"),
    *("${oc.env:HOME}", "${seed}", "${", "a\0b", "x" * 300, "x" * 5000, "x/" * 5000, "/", "/tmp"),
    *("/dev/zero", "/dev/null", ".", "..", "pipe.yaml", "pipe", "folder.yaml", "no.yaml", "no.npz"),
    *("policy.npz", "mine.yaml", "suite.yaml", "run", "large.yaml", "\udcff", "é", "a\nb", "a,b"),
    *("\x1b[31m", "'", '"', "'a'", "a=b", "1,2", "*", "?", "[a-", "$", "\\"),
    *("int(1)", "range(1,9)"),
]


def _write_files(draw: random.Random) -> None:
    """Writes the files that the words name into the working folder; damages at most one file."""
    faults_policies.write_sound(Path("policy.npz"), draw)
    faults_policies.write_sound(Path("b.npz"), draw)
    Path("mine.yaml").write_text(_STAGE)
    Path("suite.yaml").write_text(_SUITE)
    _write_run(Path("run"))
    os.mkfifo("pipe.yaml")
    os.mkfifo("pipe")
    Path("folder.yaml").mkdir()
    with Path("large.yaml").open("wb") as file:
        file.truncate(2**34)
    spoiled = draw.choice((None, "mine.yaml", "suite.yaml", "policy.npz", "config", "metrics"))
    if spoiled is not None:
        _spoil(spoiled, draw)


def _write_run(run: Path) -> None:
    """Writes the directory of a run without checkpoints."""
    run.mkdir()
    config = to_dict(load_train(["stage=s1", "budget=1e6"]))
    (run / "config.json").write_text(json.dumps(config))
    lists = {key: [0.5] for key in ("mix", "weights", *rows.BY_STAGE)}
    row = {"update": 1, "seed": 0, "arena_steps": 4096, "train_s": 1.0, "return": 0.1, **lists}
    (run / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    facts = {"format": 3, "settings": to_dict(ReproduceConfig()), "versions": {}}
    (run / "reproduce.json").write_text(json.dumps(facts))


def _spoil(name: str, draw: random.Random) -> None:
    """Damages one of the files in the working folder."""
    where = {"config": "run/config.json", "metrics": "run/metrics.jsonl"}
    path = Path(where.get(name, name))
    if name == "policy.npz":
        kind = draw.choice(sorted(faults_policies.DAMAGE))
        path.write_bytes(faults_policies.DAMAGE[kind](path.read_bytes(), draw))
        return
    text = path.read_text()
    for _ in range(draw.choice((1, 1, 2, 5))):
        text = mutate_text(text, draw)
    path.write_bytes(text.encode("utf-8", "surrogateescape"))


def mutate_text(text: str, draw: random.Random) -> str:
    """Changes a YAML or JSON text: a few letters, a line, a value, or the whole text.

    Args:
      text: the text of a file.
      draw: random source of the change.
    """
    lines = text.splitlines(keepends=True) or [""]
    at, line = draw.randrange(len(text) + 1), draw.randrange(len(lines))
    bomb = "".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 20))
    nasty = draw.choice(_NASTY)
    head = lines[line].partition(":")[0]
    return draw.choice(
        (
            lambda: text[:at] + draw.choice("[]{}:-&*!|>'\"%@`#,\n\t 0\0\udcff") + text[at:],
            lambda: text[:at] + text[at + draw.randrange(1, 9) :],
            lambda: "".join([*lines[:line], f"{head}: {nasty}\n", *lines[line + 1 :]]),
            lambda: _other_value(text, draw),
            lambda: _other_value(text, draw),
            lambda: "".join([*lines[:line], lines[line], *lines[line:]]),
            lambda: "".join([*lines[:line], *lines[line + 1 :]]),
            lambda: "a0: &a0 [1]\n" + bomb + text,
            lambda: text + draw.choice(("[" * 100_000, "{" * 50_000, "- " * 50_000, '"' * 9)),
            lambda: draw.choice(("", nasty, "null", "[]", "[1]", "{}", "a: " + nasty)),
        )
    )()


def _other_value(text: str, draw: random.Random) -> str:
    """Replaces a number or a word in the text of a file with a value from `_NASTY`."""
    found = [*re.finditer(r"(?<=: )[\w.\"-]+", text)]
    if not found:
        return text
    start, end = draw.choice(found).span()
    return f"{text[:start]}{draw.choice(_NASTY)}{text[end:]}"


def _mutate_words(words: list[str], cls: type[Section], draw: random.Random) -> list[str]:
    """Makes a mutated word, and appends it or replaces an existing word with it."""
    keys = [*section.keys(cls), *files.defaults(cls.command)]
    at = draw.randrange(len(words)) if words else 0
    nasty, key = draw.choice(_NASTY), draw.choice(keys)
    word = words[at] if words else "seed=0"
    cut = draw.randrange(max(1, len(word)))  # an earlier mutation may have left an empty word
    changed = draw.choice(
        (
            *[f"{key}={nasty}"] * 5,
            f"{key}={draw.choice((draw.random(), draw.randrange(-9, 99), [0.1, 0.2], 'true'))}",
            f"{key}.{draw.choice(keys)}=1",
            f"{word.partition('=')[0]}={nasty}",
            word[:cut] + draw.choice("=.,'\"[]{}$:é \t\\+~@") + word[cut:],
            word[:cut] + word[cut + 1 :],
            draw.choice((nasty, f"++{word}")),
        )
    )
    if draw.random() < 0.4:
        return [*words[:at], changed, *words[at + 1 :]]
    return [*words, changed]


def _command_line(name: str, draw: random.Random) -> list[str]:
    """Makes the words of a command line: valid words with up to four mutations."""
    words = draw.choice(_SOUND[name]).split()
    for _ in range(draw.choice((0, 1, 1, 2, 4))):
        words = _mutate_words(words, LOADERS[name][1], draw)
    return words


# Outcomes


class _Hang(BaseException):
    """Raised when a trial takes too long."""


@contextlib.contextmanager
def _limited(folder: Path) -> Iterator[None]:
    """Changes to a folder and limits time and memory; restores everything afterwards."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise _Hang

    before, place = resource.getrlimit(resource.RLIMIT_AS), Path.cwd()
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGALRM, stop)
    os.chdir(folder)
    resource.setrlimit(resource.RLIMIT_AS, (held + _MOST_MEMORY, before[1]))
    signal.setitimer(signal.ITIMER_REAL, _MOST_WAITING)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)
        os.chdir(place)


def in_process(name: str, words: Words, folder: Path) -> tuple[str, str]:
    """Does the first part of a command in this process.

    Args:
      name: name of the command.
      words: its words.
      folder: folder of the files that the words name.

    Returns:
      The outcome and the message.
    """
    try:
        with _limited(folder):
            LOADERS[name][0](words)
        return "runs", ""
    except (ConfigError, PolicyError) as error:
        is_one = faults_policies.is_sentence(str(error))
        return "refused" if is_one else "NO SENTENCE", str(error)
    except _Hang:
        return "HANG", ""
    except MemoryError:
        return "TOO MUCH MEMORY", ""
    except OSError as error:  # `command.run` turns the error into a sentence if it names a file
        return ("refused" if error.filename is not None else "TRACEBACK"), repr(error)
    except Exception as error:
        return "TRACEBACK", repr(error)


def process(name: str, command: Words, folder: Path) -> tuple[str, str]:
    """Runs a command in a separate process.

    Args:
      name: name of the command.
      command: arguments of the Python interpreter, including the words.
      folder: folder of the files that the words name.

    Returns:
      The outcome and the message.
    """
    try:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=folder,
            env=os.environ | _ENVIRONMENT,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_PROCESS_SECONDS,
            preexec_fn=_limit_memory,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "HANG", ""
    said = done.stderr.decode(errors="replace")
    if "Traceback" in said:
        return "TRACEBACK", said
    if done.returncode != 2:
        return "runs" if done.returncode in (0, 130) else f"CODE {done.returncode}", said
    line = said.removesuffix("\n")
    if f"swarmjax.{name}: error: " not in line or not faults_policies.is_sentence(line):
        return "NO SENTENCE", said
    return "refused", said


def spent() -> float:
    """Returns the processor time of this process and of its finished children, s."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in both)


def _kept_in(word: str) -> str:
    """Replaces a path outside the folder; removes null characters, which no process can receive."""
    key, equals, value = word.partition("=")
    if value.strip("'\"").startswith(("/", "..")):
        value = "elsewhere"
    return f"{key}{equals}{value}".replace("\0", "")


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_PROCESS_MEMORY, _PROCESS_MEMORY))


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Runs a command on mutated words and files.

    Args:
      seed: seed of the mutations.
      folder: folder for the files.

    Returns:
      The entries of the line.
    """
    draw = random.Random(seed)
    name = draw.choice(sorted(LOADERS))
    words = _command_line(name, draw)
    with contextlib.chdir(folder):
        _write_files(draw)
    is_process = seed % _EVERY == 0
    began, before = time.perf_counter(), spent()
    if is_process:
        typed = [_kept_in(word) for word in words]
        command = ["-m", f"swarmjax.{name}", *typed, *_TINY[name]]
        outcome, said = process(name, command, folder)
    else:
        outcome, said = in_process(name, words, folder)
    used = spent() - before
    return {
        "outcome": "SLOW" if outcome == "refused" and used > MOST_SECONDS else outcome,
        "command": name,
        "how": "process" if is_process else "in process",
        "words": [ascii(word[:100]) for word in words],
        "said": ascii(said[-300:]),
        "processor_s": round(used, 3),
        "seconds": round(time.perf_counter() - began, 3),
    }
