"""What all commands share: `--help`, and errors of the user's in one sentence with exit code 2."""

import sys
from collections.abc import Callable, Sequence

from swarmjax.config import ConfigError, files, section
from swarmjax.config.section import Section
from swarmjax.policy import PolicyError

USER_ERROR = 2
INTERRUPTED = 130  # 128 + SIGINT, as a shell gives it


def run(
    name: str,
    main: Callable[[Sequence[str]], int],
    settings: type,
    also: tuple[type[Exception], ...] = (),
) -> int:
    """Runs a command on the command line's arguments.

    Args:
      name: of the command, `train` say.
      main: takes the arguments, returns the exit code.
      settings: the dataclass of the command's keys, for `--help`.
      also: further errors that are the user's to mend.

    Returns:
      The exit code: 2 for an error of the user's, which is printed in one sentence.
    """
    arguments = sys.argv[1:]
    module = _module(name)
    try:
        if {"-h", "--help"} & set(arguments):
            sys.stdout.write(help_text(settings, module) + "\n")
            return 0
        return main(arguments)
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ConfigError, PolicyError, *also) as error:
        sys.stderr.write(f"{module}: error: {error}\n")
        return USER_ERROR


def _module(name: str) -> str:
    """The command as `python -m` names it: benchmarks are not part of the package."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    found = "" if spec is None else spec.name.removesuffix(".__main__")
    return found if found.rpartition(".")[2] == name else f"swarmjax.{name}"


def help_text(cls: type[Section], module: str) -> str:
    """Describe a command's settings: groups with their choices, then every key.

    Args:
        cls: the command's dataclass.
        module: the command as `python -m` names it, such as `swarmjax.train`.

    Returns:
        Lines for a terminal, without a newline at the end.
    """
    lines = [f"usage: python -m {module} key=value ..."]
    groups = files.describe_groups(cls.command) if cls.command else []
    if groups:
        lines += ["", "Groups, each a folder of configs/:", *groups]
    return "\n".join([*lines, "", "Keys, with their defaults:", *section.describe_keys(cls)])
