"""What adapters ask of another library, and of whoever uses it."""

import importlib
from typing import Any


def fault(action: Any, shape: tuple[int, ...]) -> str | None:
    """Says in a sentence what is wrong with the shape or dtype of an action; None: nothing."""
    if tuple(action.shape) != shape:
        return f"action has the shape {tuple(action.shape)}: give {shape}, speed and turn rate."
    if "float" not in str(action.dtype):
        return f"action is of dtype {action.dtype}: give float32, -1 to 1."
    return None


def check(action: Any, shape: tuple[int, ...], whose: str = "") -> None:
    """Refuses an action, for libraries that have no errors of their own.

    Args:
      action: what a robot or several are told.
      shape: that it must have.
      whose: put before the sentence.

    Raises:
      ValueError: it has another shape.
      TypeError: it is of a wrong dtype.
    """
    if sentence := fault(action, shape):
        kind = ValueError if tuple(action.shape) != shape else TypeError
        raise kind(whose + sentence)


def find(module: str, extra: str, name: str | None = None) -> Any:
    """Imports a module of another library, or takes something out of it.

    Raises:
      ImportError: it is missing or too old; the sentence names the extra that brings it.
    """
    try:
        found = importlib.import_module(module)
        return found if name is None else getattr(found, name)
    except (ImportError, AttributeError) as error:
        reason = str(error).strip().partition("\n")[0].rstrip(".")
        raise ImportError(
            f"{module} cannot be used here ({reason}): pip install swarmjax[{extra}]."
        ) from error
