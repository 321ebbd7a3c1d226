"""Handles `--help` and the user's errors (one sentence, exit code 2) for all commands."""

import ast
import importlib.util
import inspect
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path

from swarmjax.config import ConfigError, files, reading, section
from swarmjax.config.section import Section
from swarmjax.exit_codes import FAILED, INTERRUPTED, USER_ERROR
from swarmjax.policy import PolicyError

HELP = {"-h", "--help"}
_LOST_WORKER = (
    "a worker process died before its work was done, perhaps because memory ran out: give fewer "
    "workers, as in workers=1."
)
_ALL = "all"  # the help topic that lists every key


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
      The exit code: 2 for the user's errors, each of which is printed as one sentence.
    """
    module, arguments = _module(name), sys.argv[1:]
    try:
        if HELP & set(arguments):
            topics = [word for word in arguments if word not in HELP and "=" not in word]
            sys.stdout.write(help_text(settings, module, topics) + "\n")
            code = 0
        else:
            code = main(arguments)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # nobody reads the output any more, as with `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        mistake = explain(error, also)
        if mistake is None:
            raise
        sentence, code = mistake
        sys.stderr.write(f"{module}: error: {sentence}\n")
        return code


def explain(error: Exception, also: tuple[type[Exception], ...] = ()) -> tuple[str, int] | None:
    """Describes an error that the user can fix.

    Args:
      error: the error.
      also: types of further errors that the user can fix.

    Returns:
      One sentence, and the exit code of a command. None for an error that the user cannot fix.
    """
    if isinstance(error, (ConfigError, PolicyError, *also)):
        return str(error), USER_ERROR
    if isinstance(error, BrokenExecutor):
        return _LOST_WORKER, FAILED
    if isinstance(error, OSError) and error.filename is not None:
        # A file cannot be read or written, and the command has not handled the error itself.
        name = reading.called(str(error.filename))
        return f"{name} cannot be used: {error.strerror}.", USER_ERROR
    return None


def line(name: str, *arguments: str) -> str:
    """Formats a command so that it can be pasted into a shell.

    Args:
      name: name of the command, such as `evaluate`.
      arguments: the command's `key=value` words.
    """
    return shlex.join(["python", "-m", f"swarmjax.{name}", *arguments])


def _module(name: str) -> str:
    """Returns a command's name for `python -m`, or the path of a script outside the package."""
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
      topics: sections or keys to list, or `all`. Without topics, the text has the usage, examples,
        groups, and the keys that are outside sections.

    Returns:
      Lines for a terminal, without a newline at the end.

    Raises:
      ConfigError: if there is no such topic.
    """
    return "\n".join(_listed(cls, topics) if topics else _overview(cls, module))


def _listed(cls: type[Section], topics: Sequence[str]) -> list[str]:
    """Describes the keys that the topics name, one line per key."""
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


def _examples(module: str) -> list[str]:
    """Reads the examples in the docstring of a command's module, without importing JAX."""
    if module.endswith(".py"):
        return []
    spec = importlib.util.find_spec(module)
    if spec is not None and spec.submodule_search_locations:
        spec = importlib.util.find_spec(f"{module}.__main__")
    if spec is None or spec.origin is None:
        return []
    text = ast.get_docstring(ast.parse(Path(spec.origin).read_text())) or ""
    _, title, examples = text.partition("Examples:\n")
    return f"{title}{examples}".splitlines()


def _overview(cls: type[Section], module: str) -> list[str]:
    """Describes how to use a command, but does not list the keys inside its sections."""
    command = f"python {module}" if module.endswith(".py") else f"python -m {module}"
    top = [key for key in section.keys(cls) if "." not in key]
    blocks = (
        _examples(module),
        ["Groups of files, each a folder of configs/:", *files.describe_groups(cls)],
        ["Keys, with their defaults:", *section.describe_keys(cls, top)],
        [f"Sections of keys; {command} --help all lists all keys:", *_describe_sections(cls)],
    )
    lines = [f"usage: {command} key=value ..."]
    for block in blocks:
        lines += ["", *block] if len(block) > 1 else []
    return lines


def _describe_sections(cls: type[Section]) -> list[str]:
    """Returns a line for each section of keys, with the first line of the section's docstring."""
    lines = []
    for name, each in section.sections(cls).items():
        meaning = (inspect.getdoc(each) or "").partition("\n")[0].rstrip(".:;")
        lines.append(f"  {f'--help {name}':<38}  {name}.*: {meaning}")
    return lines
