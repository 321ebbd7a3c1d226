"""Statistics of running and finished episodes."""

from typing import NamedTuple

from jax import Array


class Episode(NamedTuple):
    """Sums of a running episode.

    Attributes:
      reward: [R] sum of rewards.
      contacts: [R, 3] contacts of each kind.
      sensed: [R] control steps in which a ray was shorter than the infrared range (the paper's rule
        for collisions).
      moving: [R] control steps that began before arrival. With `task.arrival=hold`, these are the
        steps that began outside the target.
    """

    reward: Array
    contacts: Array
    sensed: Array
    moving: Array


class Robots(NamedTuple):
    """Results of each robot in finished episodes, [T, A, R]; zero where no episode ended.

    Attributes:
      present: whether the robot was present; if not, ignore its other fields.
      reached: whether the robot had arrived at the end.
      reward: undiscounted sum of rewards over the episode.
      robot_steps: control steps before arrival.
      sensed: control steps in which a ray was shorter than the infrared range.
      contacts: contacts of all kinds.
    """

    present: Array
    reached: Array
    reward: Array
    robot_steps: Array
    sensed: Array
    contacts: Array


class Ended(NamedTuple):
    """Finished episodes by control step and arena, [T, A, ...]; zero where no episode ended.

    Attributes:
      episodes: 1 where an episode ended.
      stage: index of the stage on which the episode began.
      cohort: the curriculum's cohort in which the episode began; -1 where no episode ended.
      targets: number of robots present.
      reached: number of robots that had arrived at the end.
      all_reached: 1 where every robot had arrived.
      steps: control steps of the episode.
      robot_steps: control steps before arrival, summed over robots.
      sensed: control steps in which a ray was shorter than the infrared range, summed over robots.
      contacts: [.., 3] contacts of each kind, summed over robots.
      reward: undiscounted sum of rewards, summed over robots.
      broken: 1 where the episode ended because `TimeStep.sound` was false.
      measured: [.., K] the goal's own measures; None if it has none.
      robots: results per robot, if `run.episodes` asks for them.
    """

    episodes: Array
    stage: Array
    cohort: Array
    targets: Array
    reached: Array
    all_reached: Array
    steps: Array
    robot_steps: Array
    sensed: Array
    contacts: Array
    reward: Array
    broken: Array
    measured: Array | None = None
    robots: Robots | None = None
