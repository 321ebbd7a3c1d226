"""Tests the measures of episodes, worked out by hand."""

import numpy as np
import pytest

from swarmjax.evaluate import measures
from swarmjax.evaluate.measures import MEASURES, Outcome

STEP, STEPS = 0.1, 30  # s; control steps of an episode


def _outcome() -> Outcome:
    """Returns three levels of two robots: two, one and none of the robots arrive."""
    contacts = np.zeros((3, 2, 3), int)
    contacts[0, 0] = [1, 0, 2]
    contacts[2, 1] = [1, 2, 0]
    touched = 3 * contacts
    return Outcome(
        clock=np.array([10, 30, 30]),
        arrived=np.array([[True, True], [True, False], [False, False]]),
        arrival=np.array([[4, 10], [6, 0], [0, 0]]),
        contacts=contacts,
        touched=touched,
        sensed=np.array([[1, 2], [3, 4], [0, 15]]),
        moving=np.array([[4, 10], [6, 20], [30, 30]]),
        path=np.array([[0.5, 1.0], [0.25, 3.0], [0.0, 2.0]]),
        still=np.array([[30, 0], [0, 60], [60, 49]]),
        anchor=np.zeros((3, 2, 2)),
        measured=np.zeros((3, 0)),
    )


def test_per_level_by_hand() -> None:
    shortest = np.array([[0.4, 1.1], [0.25, 1.0], [1.0, np.inf]])
    found = measures.per_level(_outcome(), STEP, STEPS, shortest)
    expected = {
        "targets_reached": [1.0, 0.5, 0.0],
        "all_reached": [1.0, 0.0, 0.0],
        # A robot that has not arrived counts with the whole episode of 3 s.
        "time_to_reach_s": [(0.4 + 1.0) / 2, (0.6 + 3.0) / 2, 3.0],
        "episode_time_s": [1.0, 3.0, 3.0],
        # On the first level the robots have 0.4 / 0.5, and 1 for a path shorter than the shortest
        # path. On the second level they have 1 and 0.
        "spl": [(0.8 + 1.0) / 2, 0.5, 0.0],
        "contacts_per_robot": [1.5, 0.0, 1.5],
        "contacts_robot": [0.5, 0.0, 0.5],
        "contacts_obstacle": [0.0, 0.0, 1.0],
        "contacts_wall": [1.0, 0.0, 0.0],
        "contact_s_per_robot": [0.45, 0.0, 0.45],  # three steps per contact
        "contact_s_robot": [0.15, 0.0, 0.15],
        "contact_s_obstacle": [0.0, 0.0, 0.3],
        "contact_s_wall": [0.3, 0.0, 0.0],
        "ir_steps_share": [3 / 14, 7 / 26, 15 / 60],
        # A robot is in a deadlock after 50 steps (5 s) at rest, unless it has arrived.
        "deadlocks": [0.0, 0.5, 0.5],
        "time_outs": [0.0, 1.0, 1.0],
    }
    assert list(found) == list(MEASURES) == list(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-12, err_msg=name)


def test_without_shortest_paths_there_is_no_path_efficiency() -> None:
    found = measures.per_level(_outcome(), STEP, STEPS)
    assert set(MEASURES) - set(found) == {"spl"}


@pytest.mark.parametrize(
    ("arrived", "shortest", "driven", "expected"),
    [
        (True, 0.0, 0.0, 1.0),  # the robot starts within the target's radius
        (True, 0.0, 0.3, 0.0),
        (True, np.inf, 0.3, 0.0),  # cannot happen
        (False, 1.0, 0.3, 0.0),
        (True, 1.0, 4.0, 0.25),
    ],
)
def test_path_efficiency(arrived: bool, shortest: float, driven: float, expected: float) -> None:
    one = _outcome()._replace(arrived=np.array([[arrived]]), path=np.array([[driven]]))
    one = one._replace(**{n: getattr(one, n)[:1, :1] for n in ("arrival", "sensed", "moving")})
    one = one._replace(**{n: getattr(one, n)[:1, :1] for n in ("contacts", "touched")})
    one = one._replace(clock=one.clock[:1], still=one.still[:1, :1])
    found = measures.per_level(one, STEP, STEPS, np.array([[shortest]]))
    np.testing.assert_allclose(found["spl"], [expected])
