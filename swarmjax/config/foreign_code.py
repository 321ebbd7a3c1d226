"""Turns an exception from a user's code into a refusal of one sentence."""

import contextlib
from collections.abc import Iterator

from swarmjax.config.values import ConfigError


@contextlib.contextmanager
def explained(what: str) -> Iterator[None]:
    """Turns any exception from a user's code into one sentence, even that of `sys.exit()`.

    Args:
      what: the beginning of the sentence, such as "FILE does not import".

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
