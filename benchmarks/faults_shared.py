"""A campaign of `benchmarks.faults`: files from strangers, watched by Python's audit hooks.

A trial writes a recipe, a stage, a robot, a suite or a policy that tries to run a file, call a
socket, read the environment or write somewhere. A command then reads it. Most trials do only the
first part of a command, in this process; one trial in `_EVERY` runs the whole command as a process.
The outcome names what the command must not do: IMPORT, SOCKET, ENVIRONMENT or WRITE. Otherwise the
command runs, or refuses the file in one sentence within `MOST_SECONDS` of processor time.
"""

import json
import os
import random
import runpy
import sys
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import faults_inputs, faults_policies

MOST_SECONDS = 5.0  # s of processor time until a file is refused
_EVERY = 50  # one of this many trials runs a whole command
_SECRET = "SWARMJAX_SECRET"
_EVIL = "evil.py"
_SEEN = "seen: "
# What a command may write: its own output, and temporary files.
_OUT, _TMP = "out", "tmp"
_CALLS = ("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.sendto")
# The last entry of these events is the number of the open folder in which the name lies, or -1.
_CHANGES = ("os.remove", "os.rename", "os.mkdir", "os.rmdir")

# For each kind of file: its name, its sound text and the command that reads it.
_TEXTS = {
    "recipe": ("mine.yaml", "stage: s1\nalgo:\n  epochs: 2\ntask:\n  reward:\n    contact: -0.1\n"),
    "stage": ("mine.yaml", "robots: 2\nside: 1.0\nobstacles: 1\nobstacle_size: 0.1\n"),
    "robot": ("mine.yaml", "body: planar\nmax_speed: 0.1\n"),
    "suite": ("mine.yaml", "cells:\n- name: one\n  stage: s1\n  levels: 2\n  seed: 1000001\n"),
    "policy": ("policy.npz", ""),
}
_COMMANDS = {
    "recipe": ("train", ["recipe=mine.yaml"]),
    "stage": ("train", ["stage=mine.yaml"]),
    "robot": ("train", ["robot=mine.yaml"]),
    "suite": ("evaluate", ["policy=sound.npz", "suite=mine.yaml"]),
    "policy": ("evaluate", ["policy=policy.npz", "episodes=1"]),
}
_SMALL = {
    "train": [
        *("arenas=8", "budget=32", "algo.rollout_length=2", "algo.num_minibatches=1", "seeds=1"),
        *("task.step_limit=4", "run.dir=out", "run.tensorboard=false"),
    ],
    "evaluate": ["steps=2", "workers=1", "out=out"],
}
_KEYS = [
    *("extensions", "resume", "init_from", "recipe", "run.dir", "run.distributed", "run.wandb"),
    *("stage", "robot", "algo", "realism", "curriculum.mode", "level", "name"),
    *("task.observations", "task.reward.extra", "algo.network", "defaults", "hydra"),
    *("cells", "map"),
    *("side", "body", "max_speed", "sequence", "grid", "seed", "devices", "digest", "<<", "import"),
]
_VALUES = [
    *(_EVIL, f"./{_EVIL}", f"[{_EVIL}]", "out/../elsewhere", "/etc/hostname"),
    *("../mine.yaml", "~/x"),
    *("${oc.env:" + _SECRET + "}", f"${_SECRET}", "x/${oc.env:" + _SECRET + "}", "${seed}", "${x}"),
    *("127.0.0.1:9", "http://127.0.0.1:9/a.yaml", "python:evil", "evil:main", "pipe.yaml"),
    *("!!timestamp 2020-01-01", "!!set {a}", "!!binary aGk=", "!!python/name:os.system", "!x y"),
    *("!!python/object/apply:os.system [touch elsewhere]", "!!python/module:evil", "[[[[]]]]"),
    *("*a", "&a [*a]", "{" + "a: {" * 40, "1e999", ".nan", "9" * 4999, "x" * 6000, "'\\0'", "null"),
]


class _Watch:
    """What a trial has done that it must not do, such as `WRITE elsewhere`."""

    def __init__(self) -> None:
        self.folder: Path | None = None  # None: between trials, when all is allowed
        self.seen = list[str]()
        self.is_on = False

    def audit(self, event: str, values: tuple[Any, ...]) -> None:
        """Takes an event of `sys.addaudithook`."""
        if self.folder is None:
            return
        if event in _CALLS:
            self.note("SOCKET", values[-1])
        elif event in _CHANGES:
            base = Path(f"/proc/self/fd/{values[-1]}").resolve() if values[-1] >= 0 else self.folder
            self.written(base / os.fsdecode(values[0]))
        elif event == "open" and isinstance(values[0], str | bytes):
            path = self.folder / os.fsdecode(values[0])
            if values[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                self.written(path)
            elif path.name == _EVIL:
                self.note("IMPORT", path)
        elif event == "exec" and str(getattr(values[0], "co_filename", "")).endswith(_EVIL):
            self.note("IMPORT", values[0].co_filename)

    def written(self, path: Path) -> None:
        """Records a path that was written, unless it is in an allowed folder."""
        assert self.folder is not None
        allowed = (self.folder / _OUT, self.folder / _TMP, Path("/dev"))
        # Making a file without a name opens its folder.
        if path != self.folder and not any(root in (path, *path.parents) for root in allowed):
            self.note("WRITE", path)

    def note(self, what: str, detail: object) -> None:
        """Records something that the trial must not do."""
        self.seen.append(f"{_SEEN}{what} {detail}")
        if __name__ == "__main__":  # the parent reads it
            os.write(2, f"\n{_SEEN}{what} {detail}\n".encode())


_WATCH = _Watch()


def watch() -> None:
    """Watches this process from now on, while `_WATCH.folder` is set. This cannot be undone."""
    _WATCH.is_on = True
    sys.addaudithook(_WATCH.audit)
    read = type(os.environ).__getitem__

    def noted(environment: Any, key: Any) -> Any:
        if _WATCH.folder is not None and key == _SECRET:
            _WATCH.note("ENVIRONMENT", key)
        return read(environment, key)

    type(os.environ).__getitem__ = noted  # pyright: ignore[reportAttributeAccessIssue]


# Files


def _hostile_text(text: str, draw: random.Random) -> str:
    """Adds an entry to a YAML text, or replaces or mutates one."""
    key, value = draw.choice(_KEYS), draw.choice(_VALUES)
    lines = text.splitlines(keepends=True) or ["\n"]
    at = draw.randrange(len(lines))
    head = lines[at].partition(":")[0]
    many = "".join(f"      a{number}: 1\n" for number in range(draw.choice((99, 3000, 60_000))))
    return draw.choice(
        (
            *[f"{text}{key}: {value}\n"] * 4,
            *["".join([*lines[:at], f"{head}: {value}\n", *lines[at + 1 :]])] * 3,
            f"{text}task:\n  reward:\n    extra:\n{many}",
            f"{text}run: {{dir: elsewhere, coordinator: '127.0.0.1:9'}}\n",
            f"{text}extensions: {_EVIL}\n",
            faults_inputs.mutate_text(text, draw),
        )
    )


def _hostile_policy(path: Path, draw: random.Random) -> None:
    """Writes a policy with a right digest and a hostile description."""
    faults_policies.write_sound(path, draw)
    arrays = faults_policies.arrays_of(path.read_bytes())
    meta = json.loads(str(arrays.pop("meta")))
    arrays.pop("digest")
    meta["config"] = {"extensions": _EVIL, "run": {"dir": "elsewhere"}, "resume": "elsewhere"}
    for _ in range(draw.choice((0, 1, 1, 2, 5))):
        inner, key = draw.choice([*_places(meta)])
        inner[key] = draw.choice((*_VALUES, None, 10**400, -1, [], {}, {_EVIL: _EVIL}, ["x"] * 99))
    everything = arrays | {"meta": np.array(json.dumps(meta))}
    digest = np.array(faults_policies.digest_of(everything))
    np.savez(path, allow_pickle=False, **everything, digest=digest)


def _places(found: Any) -> Iterator[tuple[Any, Any]]:
    """Yields each place of nested plain data: a list or mapping, and a key of it."""
    keys = list(found) if isinstance(found, dict) else range(len(found))
    for key in keys:
        yield found, key
        if isinstance(found[key], dict | list):
            yield from _places(found[key])


def _write(kind: str, draw: random.Random) -> None:
    """Writes the files of a trial into the working folder."""
    Path(_EVIL).write_text("open('elsewhere', 'w').close()\n")
    os.mkfifo("pipe.yaml")
    Path(_TMP).mkdir()
    faults_policies.write_sound(Path("sound.npz"), draw)
    name, text = _TEXTS[kind]
    if kind == "policy":
        _hostile_policy(Path(name), draw)
    else:
        for _ in range(draw.choice((0, 1, 1, 2, 3))):
            text = _hostile_text(text, draw)
        Path(name).write_bytes(text.encode("utf-8", "surrogateescape"))


# Trials


@contextmanager
def watched(folder: Path) -> Iterator[list[str]]:
    """Watches this process in a `with` block.

    Args:
      folder: the working folder of the command that is watched.

    Yields:
      What the command did that it must not do, a line each.
    """
    if not _WATCH.is_on:
        watch()
    os.environ[_SECRET] = "swordfish"
    _WATCH.folder, _WATCH.seen = folder, []
    try:
        yield _WATCH.seen
    finally:
        _WATCH.folder = None


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Lets a command read a hostile file.

    Args:
      seed: seed of the file.
      folder: folder for the files.

    Returns:
      The entries of the line.
    """
    draw = random.Random(seed)
    kind = draw.choice(sorted(_TEXTS))
    name, words = _COMMANDS[kind]
    with chdir(folder):
        _write(kind, draw)
    is_process, before = seed % _EVERY == 0, faults_inputs.spent()
    if is_process:
        command = ["-m", "benchmarks.faults_shared", name, *words, *_SMALL[name]]
        outcome, said = faults_inputs.process(name, command, folder)
        seen = [line for line in said.splitlines() if line.startswith(_SEEN)]
    else:
        with watched(folder) as seen:
            outcome, said = faults_inputs.in_process(name, words, folder)
    used = faults_inputs.spent() - before
    if outcome == "refused" and used > MOST_SECONDS:
        outcome = "SLOW"
    return {
        "outcome": seen[0].removeprefix(_SEEN).split()[0] if seen else outcome,
        "kind": kind,
        "how": "process" if is_process else "in process",
        "seen": [ascii(each) for each in seen[:5]],
        "said": ascii(said[-300:]),
        "processor_s": round(used, 3),
    }


if __name__ == "__main__":  # a command that watches itself
    watch()
    _WATCH.folder = Path.cwd()
    os.environ |= {key: str(_WATCH.folder / _TMP) for key in ("TMPDIR", "MPLCONFIGDIR")}
    sys.argv[:] = sys.argv[1:]
    runpy.run_module(f"swarmjax.{sys.argv[0]}", run_name="__main__", alter_sys=True)
