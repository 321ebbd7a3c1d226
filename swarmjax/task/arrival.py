"""The two arrival rules of `task.arrival`: when a robot has arrived, and whether it may drive.

- `latch`: a robot that comes within its target has arrived and stops for good.
- `hold`: a robot counts as arrived while it is within its target, but it keeps driving and may
  leave.

Under both rules an episode is complete once all robots have arrived. Under `hold`, all robots must
be within their targets in the same control step. Multi-agent path finding calls this condition
"stay at target" (Stern et al. 2019, "Multi-Agent Pathfinding: Definitions, Variants, and
Benchmarks").

The functions take arrays of any array module.
"""

from typing import Any, Literal

Arrival = Literal["latch", "hold"]


def arrived(rule: Arrival, before: Any, within: Any) -> Any:
    """Returns which robots have arrived.

    Args:
      rule: the arrival rule of the task.
      before: [..., R] whether the robot had arrived before the control step, bool.
      within: [..., R] whether the robot is within its target after the control step, bool.

    Returns:
      [..., R] bool.
    """
    return within if rule == "hold" else before | within


def arrives(rule: Arrival, before: Any, arrived: Any, present: Any) -> Any:
    """Returns which robots' episodes end in a control step because they arrive.

    Args:
      rule: the arrival rule of the task.
      before: [..., R] whether the robot had arrived before the control step, bool.
      arrived: [..., R] whether the robot has arrived after it, as `arrived` returns it.
      present: [..., R] whether the robot is present, bool.

    Returns:
      [..., R] bool; with `hold`, all robots that are present or none.
    """
    if rule == "hold":
        return present & complete(arrived, present)[..., None]
    return arrived & ~before


def complete(arrived: Any, present: Any) -> Any:
    """Returns [...] whether all robots that are present have arrived."""
    return (arrived | ~present).all(axis=-1)


def drives(rule: Arrival, before: Any) -> Any:
    """Returns which robots obey their commands in a control step.

    Args:
      rule: the arrival rule of the task.
      before: [..., R] whether the robot had arrived before the control step, bool.

    Returns:
      [..., R] bool.
    """
    return ~before | True if rule == "hold" else ~before
