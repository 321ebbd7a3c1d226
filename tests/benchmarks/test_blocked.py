"""Tests the reference of the blocked robot by symmetry and by the balance of forces."""

import numpy as np
import pytest

from benchmarks import blocked, rig
from swarmjax import epuck

COARSE = 1e-4  # s; the results that are tested here do not depend on the step


def test_mirrored_starts_end_mirrored() -> None:
    end = blocked.reference((6.28, 0.7), 0.3, COARSE)
    mirrored = blocked.reference((0.7, 6.28), -0.3, COARSE)
    np.testing.assert_allclose(mirrored, end * [1.0, -1.0, -1.0], atol=1e-9)  # rounding
    assert end[2] != 0.3


def test_a_push_straight_ahead_is_all_the_grip_that_the_skids_leave() -> None:
    x, y, yaw = blocked.reference((6.28, 6.28), 0.0, COARSE)
    assert abs(y) < 1e-9
    assert abs(yaw) < 1e-9
    # The skid carries N = F h / x, so the push is F = mu (m g - N) = mu m g / (1 + mu h / x) =
    # 0.981 N. Under this push the wall yields by F / (4000 N/m).
    force = 0.16 * 9.81 / (1.0 + 0.015 / 0.025)
    sunk = x + epuck.HULL_RADIUS - 0.5 * rig.SIDE
    assert sunk == pytest.approx(force / 4e3, rel=1e-3)  # the robot is still settling


def test_a_robot_that_is_free_drives_away() -> None:
    # The robot drives backwards from the wall at 0.0628 m/s. Friction (9.81 m/s^2) accelerates it
    # to this speed in 6 ms.
    x, _, _ = blocked.reference((-3.14, -3.14), 0.0, COARSE)
    start = 0.5 * rig.SIDE - epuck.HULL_RADIUS - blocked.GAP
    # The start from rest shortens the way by half of v^2 / (mu g), which is 0.2 mm, or 0.3 mm with
    # the load that a skid carries. At constant speed the wheels push with no force and do not slip.
    assert start - x == pytest.approx(0.0628 * blocked.SECONDS, abs=5e-4)
