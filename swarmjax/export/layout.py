"""Describes a policy's observation in words, for users of an exported policy."""

from swarmjax.policy import Policy


def entries(policy: Policy) -> list[tuple[str, str, float, float]]:
    """Lists name, unit, offset and scale of the [O] entries of a policy's observation.

    An entry is (quantity - offset) / scale. Quantity, offset and scale are in the listed unit.

    Args:
      policy: the policy.
    """
    layout = policy.meta["observation"]
    return list(zip(*(layout[key] for key in ("names", "units", "offset", "scale")), strict=True))


def table(policy: Policy) -> str:
    """Writes the observation's layout as a table.

    Args:
      policy: the policy.

    Returns:
      A Markdown table with one row per entry, without a final newline.
    """
    lines = ["| entry | quantity | unit | offset | scale |", "|---|---|---|---|---|"]
    for i, (name, unit, offset, scale) in enumerate(entries(policy)):
        lines.append(f"| {i} | {name} | {unit} | {short(offset)} | {short(scale)} |")
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


def short(value: float) -> str:
    """Writes a number with the digits of a float32.

    Args:
      value: a finite number.

    Returns:
      At most nine digits, enough to distinguish any float32 from its neighbours.
    """
    return f"{value:.9g}"
