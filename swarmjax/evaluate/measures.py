"""The outcome of episodes, and the measures for comparing policies. No JAX.

Every measure is one number per level; docs/evaluation.md gives its formula. Both engines
pass the events of each control step to `tally`.
"""

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from swarmjax.sim import gaps
from swarmjax.task.goals.goal import Measure

# A robot is in a deadlock if, when the time is out, it has not arrived and does not move (Grover,
# Liu & Sycara 2020, "Deadlock Analysis and Resolution in Multi-Robot Systems"). It does not move if
# it has stayed within STILL_RADIUS of one place for STILL_TIME. The authors require speed 0, but a
# robot that turns on the spot or pushes never has exactly that speed. This project chose both
# numbers: at full speed a robot drives 0.63 m in STILL_TIME.
STILL_RADIUS = 0.02  # m
STILL_TIME = 5.0  # s


class Outcome(NamedTuple):
    """The outcomes of episodes that are over or still running.

    Attributes:
      clock: [A] control steps since the start.
      arrived: [A, R] whether the robot has arrived; with `task.arrival=hold`, whether it is
        at its target.
      arrival: [A, R] control steps until the robot arrived; 0 if it has not arrived. With `hold`,
        control steps until its last arrival at its target.
      contacts: [A, R, 3] contacts of each kind of `gaps.KINDS`, also after arrival.
      touched: [A, R, 3] control steps that ended with the robot in contact, also after arrival.
      sensed: [A, R] control steps before arrival in which an infrared ray met something in range.
      moving: [A, R] control steps before arrival; with `hold`, control steps that began outside the
        target.
      path: [A, R] distance driven before arrival, m; with `hold`, in the steps of `moving`.
      still: [A, R] for how many control steps the robot has now stayed within STILL_RADIUS of
        `anchor`; 0 if it has arrived.
      anchor: [A, R, 2] the place where the robot last began to stand still, m.
      measured: [A, K] the goal's own measures.
    """

    clock: Any
    arrived: Any
    arrival: Any
    contacts: Any
    touched: Any
    sensed: Any
    moving: Any
    path: Any
    still: Any
    anchor: Any
    measured: Any


class Events(NamedTuple):
    """The events of a control step.

    Attributes:
      start: [A, R, 2] places of the robots before the step, m.
      place: [A, R, 2] places of the robots after the step, m.
      arrived: [A, R] whether a robot has arrived after the step.
      begins: [A, R, 3] whether a contact of each kind begins.
      touches: [A, R, 3] whether the robot touches something at the end of the step.
      sensed: [A, R] whether an infrared ray met something in range.
      under_way: [A, R] whether the robot had something to do when the step began.
      rests: [A, R] whether the robot has nothing to do after the step.
      measured: [A, K] the goal's own measures.
    """

    start: Any
    place: Any
    arrived: Any
    begins: Any
    touches: Any
    sensed: Any
    under_way: Any
    rests: Any
    measured: Any


def begin(place: Any, xp: Any, own: int = 0) -> Outcome:
    """Returns the initial, empty outcome of episodes.

    Args:
      place: [A, R, 2] starts of the robots, m.
      xp: `numpy` or `jax.numpy`.
      own: Number of the goal's own measures, K.
    """
    count = xp.zeros(place.shape[:2], int)
    by_kind = xp.zeros((*count.shape, len(gaps.KINDS)), int)
    return Outcome(
        clock=count[:, 0],
        arrived=count.astype(bool),
        arrival=count,
        contacts=by_kind,
        touched=by_kind,
        sensed=count,
        moving=count,
        path=count.astype(float),
        still=count,
        anchor=place,
        measured=xp.zeros((len(place), own), xp.float32),
    )


def tally(before: Outcome, step: Events, xp: Any) -> Outcome:
    """Adds a control step to the outcome of episodes.

    Args:
      before: Outcome before the step.
      step: Events of the step.
      xp: `numpy` or `jax.numpy`.
    """
    under_way, clock = step.under_way, before.clock + 1
    since = xp.where(~before.arrived, clock[:, None], before.arrival)
    driven = xp.linalg.norm(step.place - step.start, axis=-1)
    away = xp.linalg.norm(step.place - before.anchor, axis=-1) > STILL_RADIUS
    return Outcome(
        clock=clock,
        arrived=step.arrived,
        arrival=xp.where(step.arrived, since, 0),
        contacts=before.contacts + step.begins,
        touched=before.touched + step.touches,
        sensed=before.sensed + (under_way & step.sensed),
        moving=before.moving + under_way,
        path=before.path + xp.where(under_way, driven, 0.0),
        still=xp.where(away | step.rests, 0, before.still + 1),
        anchor=xp.where(away[..., None], step.place, before.anchor),
        measured=step.measured,
    )


def _by_kind(name: str, label: str, unit: str) -> dict[str, Measure]:
    """Makes one measure for contacts of all kinds together, and one for each kind."""
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
    "ir_steps_share": Measure("steps with infrared", "%"),
    "deadlocks": Measure("in deadlock", "%"),
    "time_outs": Measure("timed out", "%"),
}


def per_level(
    outcome: Outcome,
    control_step: float,
    steps: int,
    shortest: np.ndarray | None = None,
    own: Collection[str] = (),
) -> dict[str, np.ndarray]:
    """Computes the measures of each episode.

    Args:
      outcome: Outcome of finished episodes.
      control_step: Length of a control step, s.
      steps: Control steps until the time is out.
      shortest: [A, R] length of the shortest path from start to target, m; inf if there is none.
        None leaves out path efficiency.
      own: Names of the goal's own measures.

    Returns:
      An array [A] for each of the `MEASURES` that can be computed, in their order, and then for
      each of the goal's own measures.
    """
    late = ~outcome.arrived
    arrival = np.where(late, steps, outcome.arrival) * control_step
    values = {
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
    if shortest is not None:
        values["spl"] = _efficiency(outcome, shortest).mean(axis=-1)
    values = {name: values[name] for name in MEASURES if name in values}
    values |= {name: outcome.measured[:, i] for i, name in enumerate(own)}
    return {name: value.astype(float) for name, value in values.items()}


def _split(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Averages values [A, R, 3] over robots: for all kinds together, and for each kind."""
    kinds = values.mean(axis=1)
    each = {f"{name}_{kind}": kinds[:, i] for i, kind in enumerate(gaps.KINDS)}
    return {f"{name}_per_robot": kinds.sum(axis=-1), **each}


def _efficiency(outcome: Outcome, shortest: np.ndarray) -> np.ndarray:
    """Computes success weighted by path length for each robot, [A, R], 0 to 1.

    Anderson et al. 2018, "On Evaluation of Embodied Navigation Agents", equation 1: success times
    shortest / max(driven, shortest). A path of length 0 counts as driven perfectly.
    """
    longer = np.maximum(outcome.path, shortest)
    known = np.isfinite(longer)
    share = np.divide(shortest, longer, out=np.ones_like(longer), where=known & (longer > 0.0))
    return np.where(outcome.arrived & known, share, 0.0)
