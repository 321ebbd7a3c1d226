"""Imports other libraries for the adapters, and checks the actions that users pass to them."""

import importlib
from typing import Any


def check(
    action: Any, shape: tuple[int, ...], whose: str = "", error: type[Exception] = ValueError
) -> None:
    """Refuses an action of a wrong shape or dtype.

    Args:
      action: action of one or several robots.
      shape: the expected shape.
      whose: text at the start of the message, such as "robot_0: ".
      error: the type of the error.
    """
    given = tuple(action.shape)
    if given != shape:
        raise error(f"{whose}action has the shape {given}: give {shape}, speed and turn rate.")
    if "float" not in str(action.dtype):
        raise error(f"{whose}action is of dtype {action.dtype}: give float32, -1 to 1.")


def find(module: str, extra: str, name: str | None = None) -> Any:
    """Imports a module of another library, or one name from it.

    Raises:
      ImportError: if the library is missing or too old. The message names the extra to install.
    """
    try:
        found = importlib.import_module(module)
        return found if name is None else getattr(found, name)
    except (ImportError, AttributeError) as error:
        reason = str(error).strip().partition("\n")[0].rstrip(".")
        raise ImportError(
            f"{module} cannot be used here ({reason}): run pip install swarmjax[{extra}]."
        ) from error
