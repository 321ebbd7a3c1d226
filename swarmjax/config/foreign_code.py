"""Turns what the code of a user raises into one sentence."""

import contextlib
from collections.abc import Iterator

from swarmjax.config.values import ConfigError, show


@contextlib.contextmanager
def explained(what: str) -> Iterator[None]:
    """Turns whatever a user's code raises into one sentence, also `sys.exit()`.

    Args:
      what: the beginning of the sentence.

    Raises:
      ConfigError: if the code in the block raises anything but a `KeyboardInterrupt`.
    """
    try:
        yield
    except (ConfigError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise ConfigError(f"{what}: {_describe(error)}.") from None


def _describe(error: BaseException) -> str:
    """Formats an error of a user's code: its type and first line."""
    try:
        text = str(error).strip()
    except BaseException:  # the text is the user's code as well
        text = ""
    first = (text or "no reason given").splitlines()[0].rstrip(".")
    return f"{type(error).__name__}: {first if first.isprintable() else show(first, quote='')}"
