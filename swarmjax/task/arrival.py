"""When a robot has arrived, and who drives: the two rules of `task.arrival`, in any array module.

`latch`: a robot that comes within its target has arrived and stands for good. `hold`: it has
arrived while it is within its target; it goes on driving, and may leave again. By both an episode
is complete once all robots have arrived, which by `hold` means all in the same control step: "stay
at target" of multi-agent path finding (Stern et al. 2019, "Multi-Agent Pathfinding: Definitions,
Variants, and Benchmarks").
"""

from typing import Any, Literal

Arrival = Literal["latch", "hold"]


def arrived(rule: Arrival, before: Any, within: Any) -> Any:
    """Tells which robots have arrived.

    Args:
      rule: of the task.
      before: [..., R] whether the robot had arrived before the control step, bool.
      within: [..., R] whether it is within its target after it, bool.

    Returns:
      [..., R] bool.
    """
    return within if rule == "hold" else before | within


def drives(rule: Arrival, before: Any) -> Any:
    """Tells which robots obey their commands in a control step.

    Args:
      rule: of the task.
      before: [..., R] whether the robot had arrived before the control step, bool.

    Returns:
      [..., R] bool.
    """
    return ~before | True if rule == "hold" else ~before
