"""Tests Bug2 on single steps worked out by hand, and on a map on which `straight` fails."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import baselines, bug2
from benchmarks.bug2 import BugBody, BugMemory
from swarmjax.sim.drive import Drive
from swarmjax.task import observation

FREE = 0.04  # m; length of a ray that meets nothing
BODY = BugBody(Drive(0.02, 0.052, 6.28, 0.1256, 3.14), 0.037, 0.05, FREE, 0.032)
MAPS = Path(baselines.__file__).parent / "maps"
LEFT, RIGHT = (7, 6, 5, 4), (0, 1, 2, 3)  # the rays of each side, from front to back


def _seen(distance: float, bearing: float, **rays: float) -> np.ndarray:
    """Returns an observation [O]; the keys `ray0` to `ray7` set the lengths of rays, m."""
    lengths = [rays.get(f"ray{i}", FREE) for i in range(observation.SENSORS)]
    return np.array([*lengths, distance, bearing])


def _follower(seen: np.ndarray, **changes: object) -> BugMemory:
    """Returns the memory of a robot that left the line 0.8 m from its target for an outline."""
    arrays = {name: np.asarray(value) for name, value in changes.items()}
    return bug2.start(seen)._replace(following=np.array(True), hit=np.array(0.8), **arrays)


def _twist(action: np.ndarray) -> tuple[float, float]:
    """Returns the speed (m/s) and turn rate (rad/s) of an action."""
    return 0.0628 * (action[0] + 1.0), 3.14 * action[1]


def test_it_heads_for_a_target_dead_ahead_at_full_speed() -> None:
    seen = _seen(0.9, 0.0)
    memory, action = bug2.act(bug2.start(seen), seen, BODY)
    assert _twist(action) == pytest.approx((0.1256, 0.0))
    assert not memory.following


@pytest.mark.parametrize("ray", [0, 1, 6, 7])
def test_what_bars_the_line_is_passed_with_it_on_the_left(ray: int) -> None:
    seen = _seen(0.9, 0.0, **{f"ray{ray}": 0.01})
    memory, action = bug2.act(bug2.start(seen), seen, BODY)
    assert memory.following
    assert (memory.side, memory.hit) == (1.0, 0.9)
    assert _twist(action) == pytest.approx((0.0, -2.5))


@pytest.mark.parametrize(("side", "near"), [(1.0, LEFT), (-1.0, RIGHT)])
def test_it_keeps_to_its_side(side: float, near: tuple[int, ...]) -> None:
    """A robot too close to a wall turns away, one too far turns to the wall, else it drives on.

    The sideways ray begins 0.031 m to the side of the robot's middle. The diagonal ray begins
    0.025 m to the side, at a yaw of 0.8 rad (0.79920 on the left, 0.80081 on the right). A wall at
    0.037 + 0.012 m leaves 0.018 m for the sideways ray and 0.024 / sin 0.8 = 0.0335 m for the
    diagonal ray.
    """
    turns = {}
    for gap in (0.009, 0.012, 0.015):
        rays = {f"ray{near[2]}": gap + 0.006, f"ray{near[1]}": (gap + 0.012) / np.sin(0.8)}
        seen = _seen(0.9, 2.0, **rays)
        memory = _follower(seen, side=side, gap=gap)
        memory, action = bug2.act(memory, seen, BODY)
        assert (memory.side, bool(memory.following)) == (side, True)
        turns[gap] = side * _twist(action)[1]
    # The gain is 60 rad/s per metre, so 3 mm give 0.18 rad/s. The angle of the wall is 0 to within
    # 1 in 1,000.
    assert list(turns.values()) == pytest.approx([-0.18, 0.0, 0.18], abs=0.02)


def test_a_wall_before_it_is_turned_away_from_on_the_spot() -> None:
    seen = _seen(0.9, 0.5, ray7=0.02, ray0=0.02)
    _, action = bug2.act(_follower(seen), seen, BODY)
    assert _twist(action) == pytest.approx((0.0, -2.5))


def test_round_a_corner_it_drives_a_circle_about_it() -> None:
    """The robot drives at 0.08 m/s around a corner 0.037 + 0.012 m from its middle: 1.633 rad/s."""
    seen = _seen(0.9, 0.5)
    _, action = bug2.act(_follower(seen), seen, BODY)
    assert _twist(action) == pytest.approx((0.08, 0.08 / 0.049))


@pytest.mark.parametrize(
    ("distance", "leaves"), [(0.76, True), (0.79, False), (0.9, False)], ids=str
)
def test_it_leaves_the_outline_where_the_line_is_met_nearer(distance: float, leaves: bool) -> None:
    """The robot is on the line at heading and bearing 0; one step ago it was 1 mm off the line.

    It left the line 0.8 m from its target, and 0.03 m closer is 0.77 m.
    """
    seen = _seen(distance, 0.0)
    memory = _follower(seen, beyond=0.001)
    memory, _ = bug2.act(memory, seen, BODY)
    assert bool(memory.following) is not leaves


def test_it_does_not_leave_beside_the_line() -> None:
    seen = _seen(0.5, 0.1)  # 0.5 sin 0.1 = 0.05 m beside the line, as one step ago
    memory = _follower(seen, heading=0.0, beyond=-0.05)
    memory, _ = bug2.act(memory, seen, BODY)
    assert memory.following
    assert memory.beyond == pytest.approx(-0.5 * np.sin(0.1))


def test_its_heading_is_what_its_wheels_turned() -> None:
    """The robot turns to the right on the spot at 2.5 rad/s for 0.032 s, by 0.08 rad."""
    seen = _seen(0.9, 0.0, ray7=0.02)
    memory, _ = bug2.act(_follower(seen), seen, BODY)
    assert memory.heading == pytest.approx(-0.08)


@pytest.mark.parametrize(
    ("change", "side"),
    [
        # If the outline is gone, the robot keeps the default side. It changes sides if it is stuck,
        # or if it has gone all the way round the outline.
        ({"lost": 0.34}, 1.0),
        ({"waited": 3.1}, -1.0),
        ({"way": 0.5, "mark": [-0.9, 0.0, -0.5], "marked": 0.1}, -1.0),
    ],
    ids=["gone", "stuck", "round"],
)
def test_the_line_starts_anew_where_the_outline_makes_no_sense(
    change: dict[str, object], side: float
) -> None:
    """The new line leads from the robot to its target: a bearing of 0.5 means heading -0.5 rad."""
    seen = _seen(0.9, 0.5)
    memory, _ = bug2.act(_follower(seen, heading=-0.5, **change), seen, BODY)
    assert not memory.following
    assert memory.side == side
    assert memory.beyond == 0.0


def test_a_robot_within_its_target_stands() -> None:
    seen = _seen(0.04, 0.3)
    _, action = bug2.act(bug2.start(seen), seen, BODY)
    assert _twist(action) == (0.0, 0.0)


def test_a_dead_end_is_left_where_the_straight_line_stays() -> None:
    words = [f"stage={MAPS / 'u_trap.yaml'}", "episodes=3", "workers=1", "seed=11"]
    lines = baselines.results(["straight", "bug2"], words)
    reached = {line["who"]: line["measures"]["targets_reached"]["mean"] for line in lines}
    assert reached == {"straight": 0.0, "bug2": 1.0}
