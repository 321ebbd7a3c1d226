"""Bug2 step by step, worked out by hand, and on a map that the straight line fails."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import baselines, bug2
from benchmarks.bug2 import BugBody, BugMemory
from swarmjax.sim.drive import Drive
from swarmjax.task import observation

FREE = 0.04  # m, of a ray that meets nothing
BODY = BugBody(Drive(0.02, 0.052, 6.28, 0.1256, 3.14), 0.037, 0.05, FREE, 0.032)
MAPS = Path(baselines.__file__).parent / "maps"
LEFT, RIGHT = (7, 6, 5, 4), (0, 1, 2, 3)  # rays from ahead to behind


def _seen(distance: float, bearing: float, **rays: float) -> np.ndarray:
    """An observation [O]; a ray is `ray0` to `ray7`."""
    lengths = [rays.get(f"ray{i}", FREE) for i in range(observation.SENSORS)]
    return np.array([*lengths, distance, bearing])


def _follower(seen: np.ndarray, **changes: object) -> BugMemory:
    """A robot that follows an outline since it left the line 0.8 m from its target."""
    arrays = {name: np.asarray(value) for name, value in changes.items()}
    return bug2.start(seen)._replace(following=np.array(True), hit=np.array(0.8), **arrays)


def _twist(action: np.ndarray) -> tuple[float, float]:
    """Speed in m/s and turn rate in rad/s."""
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
    """Along a wall at the wanted gap it drives on; too close it turns away, too far it turns to it.

    The ray beside begins 0.031 m off the middle, the diagonal one at 0.025 m, at 0.8 rad (0.79920,
    on the right 0.80081): a wall at 0.037 + 0.012 m leaves 0.018 m and 0.024 / sin 0.8 = 0.0335 m.
    """
    turns = {}
    for gap in (0.009, 0.012, 0.015):
        rays = {f"ray{near[2]}": gap + 0.006, f"ray{near[1]}": (gap + 0.012) / np.sin(0.8)}
        seen = _seen(0.9, 2.0, **rays)
        memory = _follower(seen, side=side, gap=gap)
        memory, action = bug2.act(memory, seen, BODY)
        assert (memory.side, bool(memory.following)) == (side, True)
        turns[gap] = side * _twist(action)[1]
    # 60 rad/s for each metre: 0.18 rad/s for 3 mm; the angle of the wall is 0 but for 1 in 1,000.
    assert list(turns.values()) == pytest.approx([-0.18, 0.0, 0.18], abs=0.02)


def test_a_wall_before_it_is_turned_away_from_on_the_spot() -> None:
    seen = _seen(0.9, 0.5, ray7=0.02, ray0=0.02)
    _, action = bug2.act(_follower(seen), seen, BODY)
    assert _twist(action) == pytest.approx((0.0, -2.5))


def test_round_a_corner_it_drives_a_circle_about_it() -> None:
    """0.08 m/s about a corner 0.037 + 0.012 m off the middle: 1.633 rad/s."""
    seen = _seen(0.9, 0.5)
    _, action = bug2.act(_follower(seen), seen, BODY)
    assert _twist(action) == pytest.approx((0.08, 0.08 / 0.049))


@pytest.mark.parametrize(
    ("distance", "leaves"), [(0.76, True), (0.79, False), (0.9, False)], ids=str
)
def test_it_leaves_the_outline_where_the_line_is_met_nearer(distance: float, leaves: bool) -> None:
    """At 0 rad of heading and bearing it is on the line; a control step ago it was 1 mm off it.

    It left the line at 0.8 m; 0.03 m nearer is 0.77 m.
    """
    seen = _seen(distance, 0.0)
    memory = _follower(seen, beyond=0.001)
    memory, _ = bug2.act(memory, seen, BODY)
    assert bool(memory.following) is not leaves


def test_it_does_not_leave_beside_the_line() -> None:
    seen = _seen(0.5, 0.1)  # 0.5 sin 0.1 = 0.05 m beside it, as before
    memory = _follower(seen, heading=0.0, beyond=-0.05)
    memory, _ = bug2.act(memory, seen, BODY)
    assert memory.following
    assert memory.beyond == pytest.approx(-0.5 * np.sin(0.1))


def test_its_heading_is_what_its_wheels_turned() -> None:
    """On the spot at 2.5 rad/s, for 0.032 s: 0.08 rad to the right."""
    seen = _seen(0.9, 0.0, ray7=0.02)
    memory, _ = bug2.act(_follower(seen), seen, BODY)
    assert memory.heading == pytest.approx(-0.08)


@pytest.mark.parametrize(
    ("change", "side"),
    [
        ({"lost": 0.34}, 1.0),  # an outline that is gone: on as ever
        ({"waited": 3.1}, -1.0),  # stuck: the other side
        ({"way": 0.5, "mark": [-0.9, 0.0, -0.5], "marked": 0.1}, -1.0),  # all the way round
    ],
    ids=["gone", "stuck", "round"],
)
def test_the_line_starts_anew_where_the_outline_makes_no_sense(
    change: dict[str, object], side: float
) -> None:
    """From where it is to the target, so that the bearing of 0.5 rad is a heading of -0.5 rad."""
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
