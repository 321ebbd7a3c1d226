"""Describes a policy's observation in words, for users of an exported policy."""

from typing import NamedTuple

from swarmjax.policy import Policy


class LayoutEntry(NamedTuple):
    """One entry of an observation: (quantity - offset) / scale, in units of the quantity."""

    name: str
    unit: str
    offset: float
    scale: float


def entries(policy: Policy) -> list[LayoutEntry]:
    """Lists the entries of a policy's observation.

    Args:
      policy: the policy.

    Returns:
      [O] entries in order.
    """
    layout = policy.meta["observation"]
    keys = ("names", "units", "offset", "scale")
    return [LayoutEntry(*row) for row in zip(*(layout[key] for key in keys), strict=True)]


def table(policy: Policy) -> str:
    """Writes the observation's layout as a table.

    Args:
      policy: the policy.

    Returns:
      A Markdown table with one row per entry, without a final newline.
    """
    lines = ["| entry | quantity | unit | offset | scale |", "|---|---|---|---|---|"]
    for i, entry in enumerate(entries(policy)):
        numbers = f"{short(entry.offset)} | {short(entry.scale)}"
        lines.append(f"| {i} | {entry.name} | {entry.unit} | {numbers} |")
    return "\n".join(lines)


def trained_as(policy: Policy) -> str:
    """Names the robot and the sensors that a policy was trained with.

    Args:
      policy: the policy.

    Returns:
      Part of a sentence.
    """
    robot, sensors = policy.meta["robot"], policy.meta["sensors"]
    hull = f", hull {short(robot['hull_radius'])} m" if "hull_radius" in robot else ""
    if robot.get("hull_friction"):
        hull += f" of friction {short(robot['hull_friction'])}"
    return (
        f"robot {robot['preset']} (body {robot['body']}{hull}), sensors {sensors['preset']} "
        f"(response {sensors['response']}, range {short(sensors['range'])} m)"
    )


def holds(policy: Policy) -> bool:
    """Tells whether a policy was trained to keep driving within its target (`task.arrival=hold`).

    Args:
      policy: the policy.
    """
    return policy.meta["task"]["arrival"] == "hold"


def short(value: float) -> str:
    """Writes a number with the digits of a float32.

    Args:
      value: a finite number.

    Returns:
      At most nine digits, enough to distinguish any float32 from its neighbours.
    """
    return f"{value:.9g}"
