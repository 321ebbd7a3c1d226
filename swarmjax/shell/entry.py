"""The entry point of the console script `swarmjax`."""

import difflib
import runpy
import sys
from collections.abc import Sequence

import swarmjax
from swarmjax import command, provenance
from swarmjax.config import ConfigError, show
from swarmjax.exit_codes import USER_ERROR
from swarmjax.shell.commands import COMMANDS, settings

_TOLD = ("jax", "mujoco", "mujoco-mjx", "python")  # `--version` lists these after swarmjax


def main() -> int:
    """Runs the command line.

    Returns:
      The exit code: 2 for the user's errors. A command ends the process with its own code.
    """
    name, *rest = sys.argv[1:] or ["--help"]
    if name in COMMANDS:
        return _command(name, rest)
    with command.outputs_kept("swarmjax") as ended:
        try:
            return ended(_run(name))
        except ConfigError as error:
            sys.stderr.write(f"swarmjax: error: {error}\n")
            return USER_ERROR


def _run(name: str) -> int:
    if name in command.HELP:
        sys.stdout.write(help_text() + "\n")
    elif name == "--version":
        sys.stdout.write(_versions() + "\n")
    else:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"give one of {', '.join(COMMANDS)}."
        raise ConfigError(f"{show(name)} is not a command: {hint}")
    return 0


def _command(name: str, rest: Sequence[str]) -> int:
    """Runs a command as `python -m` does, except that help imports only the command's keys."""
    sys.argv = [sys.argv[0], *rest]
    if command.HELP & set(rest):
        return command.run(name, lambda _: 0, settings(name))
    runpy.run_module(f"swarmjax.{name}", run_name="__main__", alter_sys=True)
    return 0


def help_text() -> str:
    """Lists the commands, without a newline at the end."""
    lines = ["usage: swarmjax COMMAND key=value ...", "", "Commands:"]
    lines += [f"  {name:<10}  {each.meaning}" for name, each in COMMANDS.items()]
    lines += [
        "",
        "swarmjax COMMAND --help gives examples and keys; so does python -m swarmjax.COMMAND.",
        "swarmjax --version names the versions of swarmjax, JAX and MuJoCo.",
    ]
    return "\n".join(lines)


def _versions() -> str:
    """Lists the installed versions on one line."""
    found = provenance.versions()
    told = [f"{name} {found[name]}" for name in _TOLD if name in found]
    return ", ".join([f"swarmjax {swarmjax.__version__}", *told])
