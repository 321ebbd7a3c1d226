"""Turns what the code of a user raises into one sentence."""

import contextlib
from collections.abc import Iterator

from swarmjax.config.values import ConfigError


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
        first = (str(error).strip().splitlines() or ["no reason given"])[0].rstrip(".")
        raise ConfigError(f"{what}: {type(error).__name__}: {first}.") from None
