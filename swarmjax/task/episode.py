"""What episodes come to: while they last, and when they have ended."""

from typing import NamedTuple

from jax import Array


class Episode(NamedTuple):
    """What an episode has come to so far.

    Attributes:
      reward: [R] sum of rewards.
      contacts: [R, 3] contacts of each kind.
      sensed: [R] those of them with an infrared ray shorter than its range (the paper's
        collision rule).
      moving: [R] control steps that began before arrival; by `task.arrival=hold`, outside the
        target.
    """

    reward: Array
    contacts: Array
    sensed: Array
    moving: Array


class Robots(NamedTuple):
    """What became of the robots of episodes that ended, [T, A, R], zero where none did.

    Attributes:
      present: took part; where not, the rest means nothing.
      reached: had arrived at the end.
      reward: sum over the episode, nothing discounted.
      robot_steps: control steps before arrival.
      sensed: those with an infrared ray shorter than its range.
      contacts: of all kinds.
    """

    present: Array
    reached: Array
    reward: Array
    robot_steps: Array
    sensed: Array
    contacts: Array


class Ended(NamedTuple):
    """Episodes that ended, [T, A, ...], zero where none did.

    Attributes:
      episodes: 1 where one ended.
      stage: on which it began.
      cohort: in which it began; -1 where none ended.
      targets: robots that took part.
      reached: robots that had arrived at the end.
      all_reached: 1 where every robot had.
      steps: control steps.
      robot_steps: control steps before arrival, over all robots.
      sensed: those with an infrared ray shorter than its range.
      contacts: [.., 3] of each kind, over all robots.
      reward: sum over all robots, nothing discounted.
      broken: 1 where it ended because the physics was no longer finite.
      robots: each robot by itself, if `run.episodes` asks for it.
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
    robots: Robots | None = None
