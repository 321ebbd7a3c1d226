"""The reward: a sum of small terms, each multiplied by its weight from the config.

Equation 3 of the paper is `progress` with weight 1 and `proximity` with weight -0.001.
To add a built-in term, add a function, a row of `TERMS`, a weight in `RewardConfig` and a test.
Terms of an extension need no change here; see `swarmjax.extension.reward_term`.
Terms take JAX arrays in training and NumPy arrays in replays.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from swarmjax.extension import RewardTerm
from swarmjax.sim.dispatch import least, pieces
from swarmjax.task.config import RewardConfig

Array = Any


class Step(NamedTuple):
    """One control step of a swarm, the input of reward terms.

    Attributes:
      distance_before: [R] distance to the target, m.
      distance: [R] distance after the step, to where the target was during the step, m.
      infrared: [R, K] ray lengths after the step, m.
      sensor_range: m.
      arrives: [R] whether the robot arrived in this step; with `task.arrival=hold`, whether all
        robots are at their targets, which ends the episode.
      contact_begins: [R, 3] whether a contact of each kind began in this step.
      touching: [R, 3] whether the robot touches something of each kind after the step.
      outside: [R] whether the robot had not yet arrived when the step began.
      path_before: [R] distance along the shortest path to the target, m. None for a reward without
        a path weight, and for terms of an extension.
      path: [R] distance along the shortest path after the step, m.
      pose_before: [R, 3] x (m), y (m), yaw (rad). This field and the fields below are for
        extensions only.
      pose: [R, 3] the pose after the step.
      action: [R, 2] action, clipped to -1..1; -1 and 1 are the ends of each command's range.
      present: [R] whether the robot is present, bool.
      clock: [] control steps since the start, including this one, int32.
    """

    distance_before: Array
    distance: Array
    infrared: Array
    sensor_range: float
    arrives: Array
    contact_begins: Array
    touching: Array
    outside: Array
    path_before: Any = None
    path: Any = None
    pose_before: Any = None
    pose: Any = None
    action: Any = None
    present: Any = None
    clock: Any = None


def progress(step: Step) -> Array:
    """Returns by how many metres the robot came nearer to its target (equation 3)."""
    return step.distance_before - step.distance


def path_progress(step: Step) -> Array:
    """Returns by how many metres the shortest path to the target became shorter."""
    return step.path_before - step.path


def proximity(step: Step) -> Array:
    """Returns 1 if one or more rays are shorter than the sensor's range (equation 3)."""
    xp = step.infrared.__array_namespace__()
    parts = (step.infrared[..., i] for i in pieces(step.infrared.shape[-1], xp))
    return _number(step, step.outside & (least(parts, step.sensor_range, xp) < step.sensor_range))


def arrival(step: Step) -> Array:
    """Returns 1 in the step in which the robot arrives.

    With `task.arrival=hold`, this is the step in which all robots have arrived.
    """
    return _number(step, step.arrives)


def contact(step: Step) -> Array:
    """Returns how many contacts of any kind began in this step."""
    return _number(step, step.contact_begins.sum(axis=-1))


def touching(step: Step) -> Array:
    """Returns 1 if the robot touches something of any kind after the step.

    `contact` counts a contact only once, however long a robot then leans against a wall.
    """
    return _number(step, step.touching.any(axis=-1))


def step_penalty(step: Step) -> Array:
    """Returns 1 for every control step that begins before arrival."""
    return _number(step, step.outside)


def _number(step: Step, values: Array) -> Array:
    """Converts values to the number type of the distances."""
    return values.astype(step.distance.dtype)


TERMS: dict[str, Callable[[Step], Array]] = {
    "progress": progress,
    "path_progress": path_progress,
    "proximity": proximity,
    "arrival": arrival,
    "contact": contact,
    "touching": touching,
    "step_penalty": step_penalty,
}


def weighted(
    step: Step, weights: RewardConfig, own: Sequence[tuple[RewardTerm, float]] = ()
) -> dict[str, Array]:
    """Computes the terms of the reward.

    Args:
      step: one control step, or several with leading axes.
      weights: weight of each term; a term of weight 0 is not computed.
      own: terms of an extension with their weights.

    Returns:
      [R] by name: each term times its weight.
    """
    used = {name: getattr(weights, name) for name in TERMS if getattr(weights, name)}
    terms = {name: weight * TERMS[name](step) for name, weight in used.items()}
    return terms | {piece.name: weight * piece.function(step) for piece, weight in own}


def total(step: Step, weights: RewardConfig, own: Sequence[tuple[RewardTerm, float]] = ()) -> Array:
    """Sums the terms of `weighted`, [R]."""
    nothing = step.distance.__array_namespace__().zeros_like(step.distance)
    return sum(weighted(step, weights, own).values(), start=nothing)
