"""Checks which robots are in a deadlock: robots that stand still and have not arrived."""

import numpy as np

from swarmjax.evaluate import measures
from swarmjax.evaluate.measures import Outcome

STEP, STEPS = 0.1, 100  # s; control steps of an episode


def _level(arrived: list[bool], still: list[int]) -> Outcome:
    """Returns the outcome of one level, in which nothing else happened."""
    robots = len(arrived)
    none, kinds = np.zeros((1, robots)), np.zeros((1, robots, 3))
    return Outcome(
        clock=np.array([STEPS]),
        arrived=np.array([arrived]),
        arrival=none,
        contacts=kinds,
        touched=kinds,
        sensed=none,
        moving=none,
        path=none,
        still=np.array([still]),
        anchor=np.zeros((1, robots, 2)),
        measured=np.zeros((1, 0)),
    )


def test_a_robot_that_has_arrived_is_in_no_deadlock_however_long_it_stands() -> None:
    found = measures.per_level(_level([True, True], [80, 100]), STEP, STEPS)
    assert found["deadlocks"].tolist() == [0.0]


def test_of_robots_that_stand_those_on_their_way_are_in_a_deadlock() -> None:
    # Four robots stand still for 8 s, which is longer than 5 s. One of them has not arrived.
    found = measures.per_level(_level([True, False, True, True], [80] * 4), STEP, STEPS)
    assert found["deadlocks"].tolist() == [0.25]
