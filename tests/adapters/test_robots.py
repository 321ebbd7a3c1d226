"""Tests that a row of robots holds every present robot of the arenas and no absent robot."""

import re

import jax
import numpy as np
import pytest
from courses import ARENAS, PLACES, SEED, Course, assert_close, drawn_key, robots

from swarmjax.adapters import library
from swarmjax.adapters.robots import line_up, line_up_arena
from swarmjax.environment import Swarm


def test_absent_robots_are_left_out(swarm: Swarm) -> None:
    found = line_up(swarm)
    np.testing.assert_array_equal(found.index, PLACES)
    np.testing.assert_array_equal(found.arena, ARENAS)
    present = jax.jit(swarm.reset)(jax.random.key(0)).present
    np.testing.assert_array_equal(np.flatnonzero(present), PLACES)


def test_the_course_has_all_that_can_happen(course: Course) -> None:
    came, over = course.came, course.came.done[..., None]
    assert (came.terminated & ~over).any()  # a robot arrives and waits
    assert (came.terminated & over).any()  # the last robot of an arena arrives
    assert came.truncated.any()
    assert (over.all(axis=-1).sum(axis=0) > 1).any()  # an arena ends two episodes


def test_success_is_an_arrival_before_the_episode_ends(course: Course) -> None:
    found, over = _arrived_in_time(course), course.came.done[:, ARENAS]
    assert found.any()
    assert (over & ~found).any()


def _arrived_in_time(course: Course) -> np.ndarray:
    """Remembers [T, N] who arrives in each episode until it ends."""
    arrived, found = np.zeros(len(PLACES), bool), []
    for done, terminated in zip(course.came.done, course.came.terminated, strict=True):
        arrived |= robots(terminated)
        found.append(arrived & done[ARENAS])
        arrived = arrived & ~done[ARENAS]
    return np.array(found)


def test_robots_follow_the_course(swarm: Swarm, course: Course) -> None:
    row, state = line_up(swarm), jax.jit(swarm.reset)(drawn_key(SEED))
    step = jax.jit(row.step)
    np.testing.assert_array_equal(row.observe(state), robots(course.seen[0]))
    for t, action in enumerate(course.action):
        state, found = step(state, robots(action))
        then = jax.tree.map(lambda x: x[t], course.came)  # noqa: B023
        assert_close(found.observation, robots(course.after[t]))
        assert_close(found.last, robots(then.observation))
        assert_close(found.reward, robots(then.reward))
        for name in ("terminated", "truncated", "valid"):
            np.testing.assert_array_equal(getattr(found, name), robots(getattr(then, name)))
        np.testing.assert_array_equal(found.over, then.done[ARENAS])
        np.testing.assert_array_equal(found.is_success, _arrived_in_time(course)[t])


def test_several_arenas_are_refused(swarm: Swarm) -> None:
    with pytest.raises(
        ValueError, match=r"^arenas is 4, but this adapter steps a single arena: give arenas=1"
    ):
        line_up_arena(swarm)


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (np.zeros((3, 2), np.float32), "action has the shape (3, 2): give (4, 2), speed and turn"),
        (np.zeros((4, 2), np.int32), "action is of dtype int32: give float32, -1 to 1."),
    ],
)
def test_a_wrong_action_is_told(action: np.ndarray, sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        library.check(action, (4, 2))


def test_a_right_action_is_not() -> None:
    library.check(np.zeros((4, 2)), (4, 2))


@pytest.mark.parametrize(
    ("module", "name", "reason"),
    [
        ("absent_library", None, "No module named 'absent_library'"),
        ("json", "Newer", "module 'json' has no attribute 'Newer'"),
    ],
)
def test_a_library_that_is_missing_or_too_old(module: str, name: str | None, reason: str) -> None:
    with pytest.raises(ImportError) as caught:
        library.find(module, "extra", name)
    expected = f"{module} cannot be used here ({reason}): run pip install swarmjax[extra]."
    assert str(caught.value) == expected
