"""The reference of the blocked robot, by symmetry and by the balance of forces."""

import numpy as np
import pytest

from benchmarks import blocked, rig
from swarmjax import epuck

COARSE = 1e-4  # s; what is asked for here does not depend on the step


def test_mirrored_starts_end_mirrored() -> None:
    end = blocked.reference((6.28, 0.7), 0.3, COARSE)
    mirrored = blocked.reference((0.7, 6.28), -0.3, COARSE)
    np.testing.assert_allclose(mirrored, end * [1.0, -1.0, -1.0], atol=1e-9)  # rounding
    assert end[2] != 0.3


def test_a_push_straight_ahead_is_all_the_grip_that_the_skids_leave() -> None:
    x, y, yaw = blocked.reference((6.28, 6.28), 0.0, COARSE)
    assert abs(y) < 1e-9
    assert abs(yaw) < 1e-9
    # F = mu (m g - N), and the skid takes N = F h / x: F = mu m g / (1 + mu h / x) = 0.981 N, at
    # which the wall gives way by F / 4000 N/m.
    force = 0.16 * 9.81 / (1.0 + 0.015 / 0.025)
    sunk = x + epuck.HULL_RADIUS - 0.5 * rig.SIDE
    assert sunk == pytest.approx(force / 4e3, rel=1e-3)  # it is still settling


def test_a_robot_that_is_free_drives_away() -> None:
    # Backwards from the wall at 0.0628 m/s, which friction (9.81 m/s^2) gives it in 6 ms.
    x, _, _ = blocked.reference((-3.14, -3.14), 0.0, COARSE)
    start = 0.5 * rig.SIDE - epuck.HULL_RADIUS - blocked.GAP
    # What the start costs: half of v^2 / (mu g), 0.2 mm, or 0.3 mm with what a skid takes over;
    # and the slip that holds no force: none.
    assert start - x == pytest.approx(0.0628 * blocked.SECONDS, abs=5e-4)
