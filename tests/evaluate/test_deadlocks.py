"""Who is in a deadlock: robots that stand, but not those that stand where they were to go."""

import numpy as np

from swarmjax.evaluate import measures
from swarmjax.evaluate.measures import Outcome

STEP, STEPS = 0.1, 100  # s; control steps of an episode


def _level(arrived: list[bool], still: list[int]) -> Outcome:
    """One level of as many robots, in which nothing else happened."""
    robots = len(arrived)
    none, kinds = np.zeros((1, robots)), np.zeros((1, robots, 3))
    return Outcome(
        clock=np.array([STEPS]),
        arrived=np.array([arrived]),
        arrival=none,
        contacts=kinds,
        touched=kinds,
        impulse=kinds,
        sensed=none,
        moving=none,
        path=none,
        still=np.array([still]),
    )


def test_a_robot_that_has_arrived_is_in_no_deadlock_however_long_it_stands() -> None:
    found = measures.per_level(_level([True, True], [80, 100]), STEP, STEPS)
    assert found["deadlocks"].tolist() == [0.0]


def test_of_robots_that_stand_those_on_their_way_are_in_a_deadlock() -> None:
    # Four stand for 8 s, longer than 5 s: one of them has not arrived.
    found = measures.per_level(_level([True, False, True, True], [80] * 4), STEP, STEPS)
    assert found["deadlocks"].tolist() == [0.25]
