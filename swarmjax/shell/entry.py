"""The entry point of the console script `swarmjax`."""

import difflib
import runpy
import sys
from collections.abc import Sequence

import swarmjax
from swarmjax import command, provenance
from swarmjax.config import show
from swarmjax.exit_codes import USER_ERROR
from swarmjax.shell.commands import COMMANDS, settings


def main() -> int:
    """Runs the command line.

    Returns:
      The exit code: 2 for the user's errors. A command ends the process with its own code.
    """
    name, *rest = sys.argv[1:] or ["--help"]
    if name in COMMANDS:
        return _command(name, rest)
    if name not in {*command.HELP, "--version"}:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"give one of {', '.join(COMMANDS)}."
        sys.stderr.write(f"swarmjax: error: {show(name)} is not a command: {hint}\n")
        return USER_ERROR
    sys.stdout.write((_versions() if name == "--version" else help_text()) + "\n")
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
    """Lists on one line the versions of swarmjax and of the software that computes its results."""
    found = provenance.versions()
    names = [name for name in ("jax", "mujoco", "mujoco-mjx", "python") if name in found]
    return ", ".join(
        [f"swarmjax {swarmjax.__version__}", *(f"{name} {found[name]}" for name in names)]
    )
