"""Handles `--help` and the user's errors (one sentence, exit code 2) for all commands."""

import contextlib
import inspect
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any, TextIO

from swarmjax.config import ConfigError, files, reading, section
from swarmjax.config.section import Section
from swarmjax.exit_codes import FAILED, INTERRUPTED, USER_ERROR
from swarmjax.policy import PolicyError

HELP = {"-h", "--help"}
_LOST_WORKER = (
    "a worker process died before its work was done, perhaps because memory ran out: give fewer, "
    "as in workers=1."
)
_ALL = "all"  # the help topic that lists every key
# For each command's module: words to type after the module's name, and what they do.
EXAMPLES: dict[str, dict[str, str]] = {
    "swarmjax.train": {
        "": "the default curriculum, into a new folder of runs/",
        "stage=s6 robot=wheeled budget=8e6 arenas=512": "one stage, on wheels",
        "run.dir=runs/first seeds=4": "four seeds at once, into a folder of your choice",
        "stage=curriculum 'stage.sequence=[s1,s3,s6]'": "a curriculum of three stages",
        "init_from=runs/first realism=real": "start from a trained run, on realistic robots",
        "resume=runs/first": "go on with a run that was stopped",
        "stage=s6 run.dry=true": "compile and print the memory that the run needs",
    },
    "swarmjax.evaluate": {
        "policy=runs/first/policy.npz": "1,000 levels of its last stage, on wheels",
        "policy=runs/first/policy.npz stage=s3 robot=planar": "another stage, and the planar body",
        "policy=runs/first/policy.npz suite=headline out=judged": "a suite, with tables and plots",
        "policy='runs/first/policy-seed*.npz'": "all seeds of a run together",
        "compare=a.npz,b.npz": "two policies, level by level",
        "policy=runs/first/policy.npz realism=real episodes=200": "with noise and latency",
    },
    "swarmjax.export": {
        "run=runs/first": "write the policy of the newest checkpoint again",
        "run=runs/first step=100": "the policy of an older checkpoint",
        "run=runs/first seed=3": "one seed of several",
        "policy=policy.npz format=onnx": "for ONNX Runtime",
        "policy=policy.npz format=c out=firmware/policy_c": "C99 for a robot's firmware",
        "policy=policy.npz format=webots": "a controller for Webots",
    },
    "swarmjax.report": {
        "run=runs/first": "into runs/first/report",
        "run=runs/first out=reports/first": "into a folder of your choice",
        "runs=runs/first,runs/array,'runs/cell*'": "a table of several runs, arrays and sweeps",
    },
    "swarmjax.watch": {
        "run=runs/first": "serve a page on this machine, and print its address",
        "run=runs/first port=8000 seconds=10": "on a port of your choice, with more replays",
    },
    "swarmjax.replay": {
        "policy=runs/first/policy.npz": "level 0 of its last stage, into replay.html",
        "policy=runs/first/policy.npz level=0,7,12": "several levels",
        "policy=runs/first/policy.npz worst=5": "its five worst levels out of 1,000",
        "policy=a.npz,b.npz worst=3": "two policies side by side",
        "policy=runs/first/policy.npz stage=s3 robot=planar": "another stage and body",
        "policy=runs/first/policy.npz video=replay.mp4": "a video as well",
    },
    "swarmjax.reproduce": {
        "": "all arms, ten seeds each: hours",
        "seeds=3 budget=100000": "a first look, in minutes",
        "'arms=[curriculum,baseline]'": "two arms",
        "minutes=55 out=runs/paper": "stop after 55 minutes, with all saved",
        "resume=runs/paper": "go on with a reproduction that was stopped",
    },
    "swarmjax.verify": {
        "run=runs/first": "train it again up to its first checkpoint, and compare digests",
        "run=runs/first updates=500": "up to update 500",
    },
    "swarmjax.suite": {
        "suite=headline": "draw the levels, and check them against the digests in the suite's file",
        "suite=headline out=headline.npz": "write all levels to a file that evaluate reads",
        "suite=my_suite.yaml write=true": "put the digests into a suite of your own",
    },
}


def run(
    name: str,
    main: Callable[[Sequence[str]], int],
    settings: type,
    also: tuple[type[Exception], ...] = (),
) -> int:
    """Runs a command on the command line's arguments.

    Args:
      name: name of the command, such as `train`.
      main: takes the arguments and returns the exit code.
      settings: the dataclass that defines the command's keys, for `--help`.
      also: types of further errors that the user can fix.

    Returns:
      The exit code: 2 for the user's errors, which are printed in one sentence.
    """
    with outputs_kept(_module(name)) as ended:
        return ended(_run(name, main, settings, also))


def _run(
    name: str,
    main: Callable[[Sequence[str]], int],
    settings: type,
    also: tuple[type[Exception], ...],
) -> int:
    arguments = sys.argv[1:]
    module = _module(name)
    try:
        if HELP & set(arguments):
            topics = [word for word in arguments if word not in HELP and "=" not in word]
            sys.stdout.write(help_text(settings, module, topics) + "\n")
            return 0
        return main(arguments)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        found = explain(error, also)
        if found is None:
            raise
        sys.stderr.write(f"{module}: error: {found[0]}\n")
        return found[1]


def explain(error: Exception, also: tuple[type[Exception], ...] = ()) -> tuple[str, int] | None:
    """Describes an error that the user can mend.

    Args:
      error: the error.
      also: types of further errors that the user can fix.

    Returns:
      One sentence, and the exit code of a command; None for any other error.
    """
    if isinstance(error, (ConfigError, PolicyError, *also)):
        return str(error), USER_ERROR
    if isinstance(error, BrokenExecutor):
        return _LOST_WORKER, FAILED
    if isinstance(error, OSError) and error.filename is not None:
        # A file cannot be read or written, and the command has not handled the error itself.
        name = reading.called(str(error.filename))
        return f"{name} cannot be used: {error.strerror}.", USER_ERROR
    if isinstance(error, RuntimeError | AssertionError) and _lacks_platform():
        named = section.show(os.environ["JAX_PLATFORMS"])
        return (
            f"JAX_PLATFORMS is {named}, but JAX finds no such device here: give cpu, or unset it.",
            USER_ERROR,
        )
    return None


def _lacks_platform() -> bool:
    """Returns whether JAX_PLATFORMS names no device of this machine."""
    if not os.environ.get("JAX_PLATFORMS") or "jax" not in sys.modules:
        return False
    try:
        sys.modules["jax"].devices()
    except (RuntimeError, AssertionError):
        return True
    return False


class _Stream:
    """Standard output or error, which may lose its reader or have no room.

    Attributes:
      error: why it could not be written; None if it could.
    """

    def __init__(self, stream: TextIO | None) -> None:
        """Takes a stream; None if it was closed before the command began."""
        self._stream = stream or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Writes text, or drops it."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Writes what is buffered, or drops it."""
        self._try(self._stream.flush)

    def _try(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError as error:
            self.error = self.error or error
            # Python flushes the stream again at exit. This must not fail again.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        """Behaves otherwise like the stream itself."""
        return getattr(self._stream, name)


@contextlib.contextmanager
def outputs_kept(module: str) -> Iterator[Callable[[int], int]]:
    """Lets a command finish its work although nobody reads its output, in a `with` block.

    Args:
      module: name of the command in messages.

    Yields:
      A function that takes the command's exit code, and returns the one to end with: 1 instead of
      0 if standard output had no room.
    """
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = out, err = _Stream(sys.stdout), _Stream(sys.stderr)

    def ended(code: int) -> int:
        out.flush()
        if out.error is None or isinstance(out.error, BrokenPipeError):
            return code
        err.write(f"{module}: error: standard output cannot be written: {out.error.strerror}.\n")
        return code or FAILED

    try:
        yield ended
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def line(name: str, *arguments: str) -> str:
    """Formats a command so that it can be pasted into a shell.

    Args:
      name: name of the command, such as `evaluate`.
      arguments: its `key=value` words.
    """
    return shlex.join(["python", "-m", f"swarmjax.{name}", *arguments])


def _module(name: str) -> str:
    """Returns the name for `python -m`, or a script's path for a command outside the package."""
    main = sys.modules["__main__"]
    script = getattr(main, "__file__", None) or ""
    spec = getattr(main, "__spec__", None)
    if spec is None and os.path.basename(script) == f"{name}.py":
        return os.path.relpath(script)
    found = "" if spec is None else spec.name.removesuffix(".__main__")
    return found if found.rpartition(".")[2] == name else f"swarmjax.{name}"


def help_text(cls: type[Section], module: str, topics: Sequence[str] = ()) -> str:
    """Describes a command's settings.

    Args:
      cls: the command's dataclass.
      module: name for `python -m`, such as `swarmjax.train`, or a script's path.
      topics: sections or keys to list, or `all`. Without topics, the text has usage, examples,
        groups and the keys outside sections.

    Returns:
      Lines for a terminal, without a newline at the end.

    Raises:
      ConfigError: if there is no such topic.
    """
    return "\n".join(_listed(cls, topics) if topics else _overview(cls, module))


def _listed(cls: type[Section], topics: Sequence[str]) -> list[str]:
    """Lists the keys of topics."""
    known = section.keys(cls)
    chosen: set[str] = set()
    for topic in topics:
        name = topic.removesuffix(".*")
        found = {key for key in known if key == name or key.startswith(f"{name}.")}
        if topic != _ALL and not found:
            names = ", ".join([*section.sections(cls), _ALL])
            raise ConfigError(f"--help {topic} is not a topic: give a key, or one of {names}.")
        chosen |= set(known) if topic == _ALL else found
    return section.describe_keys(cls, chosen)


def _overview(cls: type[Section], module: str) -> list[str]:
    """Describes how to use a command, without the keys of its sections."""
    command = f"python {module}" if module.endswith(".py") else f"python -m {module}"
    lines = [f"usage: {command} key=value ..."]
    examples = EXAMPLES.get(module, {})
    if examples:
        lines += ["", "Examples:"]
    for words, meaning in examples.items():
        lines += [f"  # {meaning}", f"  {command} {words}".rstrip()]
    groups = files.describe_groups(cls) if cls.command else []
    if groups:
        lines += ["", "Groups, each a folder of configs/:", *groups]
    top = [key for key in section.keys(cls) if "." not in key]
    if top:
        lines += ["", "Keys, with their defaults:", *section.describe_keys(cls, top)]
    inner = section.sections(cls)
    if inner:
        lines += ["", f"Sections of keys; {command} --help all lists all keys:"]
    for name, each in inner.items():
        meaning = (inspect.getdoc(each) or "").partition("\n")[0].rstrip(".:;")
        lines.append(f"  {f'--help {name}':<38}  {name}.*: {meaning}")
    return lines
