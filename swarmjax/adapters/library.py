"""Imports other libraries for the adapters, and checks the actions that users pass to them."""

import importlib
from typing import Any


def fault(action: Any, shape: tuple[int, ...]) -> str | None:
    """Describes what is wrong with an action's shape or dtype; None if both are right."""
    if tuple(action.shape) != shape:
        return f"action has the shape {tuple(action.shape)}: give {shape}, speed and turn rate."
    if "float" not in str(action.dtype):
        return f"action is of dtype {action.dtype}: give float32, -1 to 1."
    return None


def check(action: Any, shape: tuple[int, ...], whose: str = "") -> None:
    """Checks an action, for libraries without their own errors.

    Args:
      action: action of one or several robots.
      shape: the expected shape.
      whose: text at the start of the error message, such as the name of an agent.

    Raises:
      ValueError: if the action has another shape.
      TypeError: if the action has a wrong dtype.
    """
    if sentence := fault(action, shape):
        kind = ValueError if tuple(action.shape) != shape else TypeError
        raise kind(whose + sentence)


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
            f"{module} cannot be used here ({reason}): pip install swarmjax[{extra}]."
        ) from error
