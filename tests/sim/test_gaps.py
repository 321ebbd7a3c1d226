"""Tests gaps against values computed by hand, and what counts as one contact."""

import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.sim import gaps

RADIUS = 0.037
STEP = 0.032  # s
ALONE = np.zeros((1, 3), np.float32)
NO_OBSTACLE = np.zeros((0, 5), np.float32)
# 1e-6 m is the rounding of float32 at the size of an arena.
TOLERANCE = 1e-6


def _gaps(pose: object, side: float, obstacle: object = NO_OBSTACLE) -> np.ndarray:
    place, box = np.asarray(pose, np.float32), np.asarray(obstacle, np.float32)
    expected = gaps.gaps(place, np.float32(side), box, RADIUS, np)
    found = gaps.gaps(jnp.asarray(place), jnp.float32(side), jnp.asarray(box), RADIUS, jnp)
    np.testing.assert_allclose(found, expected, atol=TOLERANCE)
    return expected


def test_robots() -> None:
    # The centres are 0.1, 0.05 and sqrt(0.04^2 + 0.03^2) = 0.05 apart (3-4-5 triangles).
    pose = [[0.0, 0.0, 0.0], [0.06, 0.08, 1.0], [0.03, 0.04, 2.0]]
    found = _gaps(pose, 2.0)[:, 0]
    np.testing.assert_allclose(found, 0.05 - 0.074, atol=TOLERANCE)
    found = _gaps(pose[:2], 2.0)[:, 0]
    np.testing.assert_allclose(found, 0.1 - 0.074, atol=TOLERANCE)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.0, 0.0), 0.5 - RADIUS),
        ((0.4, -0.45), 0.05 - RADIUS),  # south is nearer than east
        ((-0.48, 0.1), 0.02 - RADIUS),  # overlaps by 17 mm
        ((0.0, 0.51), -0.01 - RADIUS),  # centre outside
    ],
)
def test_walls(place: tuple[float, float], expected: float) -> None:
    assert _gaps([[*place, 0.3]], 1.0)[0, 2] == pytest.approx(expected, abs=TOLERANCE)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.3, 0.01), 0.3 - 0.1 - RADIUS),  # beside the face at x = 0.1
        ((0.01, -0.2), 0.2 - 0.05 - RADIUS),  # beside the face at y = -0.05
        ((0.13, 0.09), 0.05 - RADIUS),  # corner (0.1, 0.05), 0.03 and 0.04 away
        ((0.09, 0.0), -0.01 - RADIUS),  # inside, 10 mm behind the nearest face
        ((0.0, 0.03), -0.02 - RADIUS),  # inside, 20 mm behind the nearest face
    ],
)
@pytest.mark.parametrize("yaw", [0.0, 0.5 * np.pi, -2.0])
def test_turned_obstacle(place: tuple[float, float], expected: float, yaw: float) -> None:
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = 0.2 + cos * place[0] - sin * place[1], -0.1 + sin * place[0] + cos * place[1]
    near = _gaps([[x, y, 0.0]], 2.0, [[0.2, -0.1, yaw, 0.1, 0.05], [0.9, 0.9, 0.0, 0.05, 0.05]])
    assert near[0, 1] == pytest.approx(expected, abs=TOLERANCE)


def test_nothing_of_the_kind_is_infinitely_far() -> None:
    assert _gaps(ALONE, 1.0)[0, :2].tolist() == [np.inf, np.inf]


def _begins(gap: list[float], *, apart: float = gaps.CONTACT_PAUSE) -> list[bool]:
    """Returns whether a contact begins at each step, given one robot's gap at each step."""
    found = []
    clock = np.full((1, 3), apart)
    for value in gap:
        begins, clock = gaps.count_contacts(np.full((1, 3), value), clock, STEP, np)
        assert begins[0, 0] == begins[0, 1] == begins[0, 2]
        found.append(bool(begins[0, 0]))
    return found


OPEN, CLOSED = 0.001, -0.001


def test_contact_counts_when_it_begins() -> None:
    assert _begins([OPEN, CLOSED, CLOSED, CLOSED]) == [False, True, False, False]
    assert _begins([0.0]) == [True]  # hulls that touch without force


def test_contact_at_the_start_counts() -> None:
    assert _begins([CLOSED, CLOSED]) == [True, False]


def test_bounce_is_the_same_contact() -> None:
    # Two open steps last 0.064 s, which is shorter than the pause of 0.1 s. Any number of such
    # bounces belongs to one contact.
    assert _begins([CLOSED, OPEN, OPEN, CLOSED, OPEN, CLOSED]) == [True] + [False] * 5


def test_contact_after_the_pause_is_another() -> None:
    # Three open steps last 0.096 s, which is the pause rounded to whole control steps.
    assert _begins([CLOSED, OPEN, OPEN, OPEN, CLOSED]) == [True, False, False, False, True]


def test_pause_of_whole_steps_is_kept_whatever_the_rounding() -> None:
    # The pause of 0.1 s is ten steps of 0.01 s, whose floating-point sum is not exactly 0.1. Nine
    # steps are too few, and ten are enough.
    for steps, expected in ((9, False), (10, True)):
        clock = np.zeros((1, 3), np.float32)
        for _ in range(steps):
            _, clock = gaps.count_contacts(np.full((1, 3), OPEN), clock, 0.01, np)
        begins, _ = gaps.count_contacts(np.full((1, 3), CLOSED), clock, 0.01, np)
        assert begins.all() == expected
        assert begins.any() == expected


def test_kinds_and_robots_are_counted_apart() -> None:
    gap = np.full((2, 3), OPEN)
    gap[0, 1] = gap[1, 2] = CLOSED
    begins, apart = gaps.count_contacts(gap, np.full((2, 3), 0.5), STEP, np)
    assert begins.tolist() == [[False, True, False], [False, False, True]]
    # 1e-12 s is the rounding of float64.
    np.testing.assert_allclose(apart, np.where(begins, 0.0, 0.532), atol=1e-12)
