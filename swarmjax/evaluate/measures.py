"""What an episode comes to, and the figures by which policies are compared: NumPy only.

Every measure is one number a level, defined with its formula in docs/evaluation.md. Engines count
into an `Outcome`; nothing here knows which engine it was.
"""

from typing import NamedTuple

import numpy as np

from swarmjax.sim import gaps

# A robot that the time-out finds within STILL_RADIUS of where it was STILL_TIME before is in a
# deadlock: it has not arrived and does not move (Grover, Liu & Sycara 2020, "Deadlock Analysis
# and Resolution in Multi-Robot Systems"; there at speed 0, which a robot that turns on the spot
# or pushes never has to the last bit). Both numbers are chosen: at full speed a robot drives
# 0.63 m in that time.
STILL_RADIUS = 0.02  # m
STILL_TIME = 5.0  # s


class Outcome(NamedTuple):
    """What episodes came to, or have come to so far.

    Attributes:
        clock: [A] control steps since the start.
        arrived: [A, R] whether the robot has arrived; by `task.arrival=hold`, is within its target.
        arrival: [A, R] control steps until it arrived, 0 if it has not; by `hold`, until it was
            within its target and never outside since.
        contacts: [A, R, 3] contacts of each kind of `gaps.KINDS`, also after arrival.
        touched: [A, R, 3] control steps at whose end it touched something, likewise.
        impulse: [A, R, 3] of the normal forces at these contacts, N s, likewise; nan where the
            engine does not tell.
        sensed: [A, R] control steps before arrival with an infrared ray shorter than its range.
        moving: [A, R] control steps before arrival; by `hold`, those that began outside the target.
        path: [A, R] driven before arrival, m; by `hold`, in these steps.
        still: [A, R] control steps for which it has stayed within STILL_RADIUS of one place
            without having arrived.
    """

    clock: np.ndarray
    arrived: np.ndarray
    arrival: np.ndarray
    contacts: np.ndarray
    touched: np.ndarray
    impulse: np.ndarray
    sensed: np.ndarray
    moving: np.ndarray
    path: np.ndarray
    still: np.ndarray


class Measure(NamedTuple):
    """One number a level.

    Attributes:
        label: What a table calls it.
        unit: Of the number; `%` is a share of 0 to 1, shown in per cent; none of a count.
        is_good: Whether more of it is better.
    """

    label: str
    unit: str
    is_good: bool = False


def _by_kind(name: str, label: str, unit: str) -> dict[str, Measure]:
    """A measure over all kinds of contact, and one of each kind."""
    kinds = {f"{name}_{kind}": Measure(f"  with {kind}", unit) for kind in gaps.KINDS}
    return {f"{name}_per_robot": Measure(label, unit), **kinds}


MEASURES: dict[str, Measure] = {
    "targets_reached": Measure("targets reached", "%", is_good=True),
    "all_reached": Measure("all robots reached", "%", is_good=True),
    "time_to_reach_s": Measure("time to reach", "s"),
    "episode_time_s": Measure("episode time", "s"),
    "spl": Measure("path efficiency, SPL", "%", is_good=True),
    **_by_kind("contacts", "contacts per robot", ""),
    **_by_kind("contact_s", "in contact per robot", "s"),
    **_by_kind("impulse_ns", "impulse per robot", "N s"),
    "ir_steps_share": Measure("steps with infrared", "%"),
    "deadlocks": Measure("in deadlock", "%"),
    "time_outs": Measure("timed out", "%"),
}


def per_level(
    outcome: Outcome, control_step: float, steps: int, shortest: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """What each episode came to.

    Args:
        outcome: Of episodes that are over.
        control_step: s.
        steps: Control steps after which the time is out.
        shortest: [A, R] length of the shortest way from start to target, m, inf where there is
            none; without it there is no path efficiency.

    Returns:
        [A] of each of `MEASURES` that is known, in their order.
    """
    late = ~outcome.arrived
    arrival = np.where(late, steps, outcome.arrival) * control_step
    found = {
        "targets_reached": outcome.arrived.mean(axis=-1),
        "all_reached": outcome.arrived.all(axis=-1).astype(float),
        "time_to_reach_s": arrival.mean(axis=-1),
        "episode_time_s": outcome.clock * control_step,
        "ir_steps_share": outcome.sensed.sum(axis=-1) / np.maximum(outcome.moving.sum(axis=-1), 1),
        "deadlocks": (late & (outcome.still * control_step >= STILL_TIME)).mean(axis=-1),
        "time_outs": late.any(axis=-1) & (outcome.clock >= steps),
        **_split("contacts", outcome.contacts),
        **_split("contact_s", outcome.touched * control_step),
    }
    if not np.isnan(outcome.impulse).any():
        found |= _split("impulse_ns", outcome.impulse)
    if shortest is not None:
        found["spl"] = _efficiency(outcome, shortest).mean(axis=-1)
    return {name: found[name].astype(float) for name in MEASURES if name in found}


def _split(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Means over robots of values [A, R, 3]: of all kinds together, and of each."""
    kinds = values.mean(axis=1)
    each = {f"{name}_{kind}": kinds[:, i] for i, kind in enumerate(gaps.KINDS)}
    return {f"{name}_per_robot": kinds.sum(axis=-1), **each}


def _efficiency(outcome: Outcome, shortest: np.ndarray) -> np.ndarray:
    """Success weighted by path length of each robot [A, R], 0 to 1.

    Anderson et al. 2018, "On Evaluation of Embodied Navigation Agents", equation 1: success times
    shortest / max(driven, shortest). A way of no length is driven as well as can be.
    """
    longer = np.maximum(outcome.path, shortest)
    known = np.isfinite(longer)
    share = np.divide(shortest, longer, out=np.ones_like(longer), where=known & (longer > 0.0))
    return np.where(outcome.arrived & known, share, 0.0)
