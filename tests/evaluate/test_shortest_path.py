"""Tests shortest paths against paths worked out by hand, and against a search on a grid."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from swarmjax.evaluate import shortest_path

HULL, REACH = 0.037, 0.05
# A path along the points outside a corner is at most 0.8 mm too long for each right angle.
SLACK = 1e-3
# Four points for each right angle turn a path by 22.5 degrees each. Such a path is longer than the
# arc by this factor.
LONGER = math.tan(math.pi / 16) / (math.pi / 16)


def _shortest(
    start: list[float],
    target: list[float],
    boxes: list[list[float]],
    side: float = 2.0,
    reach: float = REACH,
) -> float:
    """Returns the length of one robot's shortest path, m."""
    found = shortest_path.shortest(
        np.array([side]),
        np.array([[start]]),
        np.array([[target]]),
        np.array(boxes, float).reshape(1, -1, 5),
        HULL,
        reach,
    )
    return float(found[0, 0])


def test_the_straight_way() -> None:
    assert _shortest([0, 0], [0.3, 0.4], []) == pytest.approx(0.45)
    assert _shortest([0, 0], [0.03, 0.0], []) == 0.0
    # The path just misses the widened outline of the box.
    beside = 0.05 + HULL + 1e-5
    assert _shortest([-0.5, beside], [0.5, beside], [[0, 0, 0, 0.05, 0.05]]) == pytest.approx(0.95)


def test_around_a_plate_by_hand() -> None:
    """The path has two tangents to a disc at the plate's tip, and an arc between the tangents."""
    half, away = 0.3, 0.4
    found = _shortest([-away, 0.0], [away, 0.0], [[0, 0, 0, 1e-9, half]])
    reach = math.hypot(away, half)
    tangent = math.sqrt(reach**2 - HULL**2)
    # The arc is a full circle at the end of the plate, less the angle between the two points and
    # the angle that each tangent takes off.
    arc = 2 * math.pi - 2 * math.atan2(away, half) - 2 * math.acos(HULL / reach)
    expected = 2 * tangent + HULL * arc
    # The last leg ends 0.05 m before the target, on the straight line to the target.
    assert expected - REACH - 1e-9 <= found <= expected - REACH + SLACK


def _taut(start: list[float], corners: list[list[float]], target: list[float]) -> list[float]:
    """Returns lengths of a taut string around discs at corners on its right: all, and arcs, m."""
    points = np.array([start, *corners, target])
    legs = np.diff(points, axis=0)
    length = np.hypot(*legs.T)
    heading = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    # The tangents at both ends deviate from the lines to the centres by asin(radius / distance).
    first, last = (math.asin(HULL / x) for x in (length[0], length[-1]))
    arcs = HULL * float(heading[0] + first - (heading[-1] - last))
    straight = float(length[1:-1].sum()) + sum(
        math.sqrt(x**2 - HULL**2) for x in (length[0], length[-1])
    )
    return [straight + arcs, arcs]


T = 0.005  # m, half the thickness of a wall


@pytest.mark.parametrize("yaw", [0.0, 0.7])
@pytest.mark.parametrize(
    ("start", "corners", "target", "walls"),
    [
        ([0.4, -0.7], [[0.0, -0.5]], [-0.2, 0.1], [[0.5, 0.0, 0.5, 0.5]]),
        # A corridor of 0.2 m bends to the right, and two walls meet at its inner corner.
        (
            [0.1, -0.5],
            [[0.2 - T, 0.0 + T]],
            [0.6, 0.1],
            [
                [0.2, -0.4, T, 0.4 + T],
                [0.5, 0.0, 0.3 + T, T],
                [0.0, -0.3, T, 0.5 + T],
                [0.4, 0.2, 0.4 + T, T],
            ],
        ),
        # The path leads out of a U, whose right side has two walls, and back behind its bottom.
        (
            [0.1, 0.1],
            [[0.2 - T, 0.4 + T], [0.2 + T, 0.4 + T], [0.2 + T, -T]],
            [0.1, -0.3],
            [
                [0.2, 0.1, T, 0.1 + T],
                [0.2, 0.3, T, 0.1 + T],
                [-0.2, 0.2, T, 0.2 + T],
                [0.0, 0.0, 0.2 + T, T],
            ],
        ),
        # The path leads past a corridor. A zigzag path of 1.97 m through the corridor is closer to
        # the straight line, but longer.
        (
            [-0.6, 0.0],
            [[-0.35, 0.3 + T], [0.35, 0.3 + T]],
            [0.6, 0.0],
            [
                [0.0, 0.3, 0.35, T],
                [0.0, -0.3, 0.35, T],
                [-0.2, -0.05, T, 0.25],
                [0.0, 0.05, T, 0.25],
                [0.2, -0.05, T, 0.25],
            ],
        ),
    ],
    ids=["corner", "bend", "U", "zigzag"],
)
def test_among_walls_by_hand(
    start: list[float],
    corners: list[list[float]],
    target: list[float],
    walls: list[list[float]],
    yaw: float,
) -> None:
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    boxes = [[*(turn @ [x, y]), yaw, *half] for x, y, *half in walls]
    found = _shortest(list(turn @ start), list(turn @ target), boxes, side=4.0)
    length, arcs = _taut(start, corners, target)
    # The last leg ends 0.05 m before the target, on the straight line to the target. Around an arc
    # the path is longer by the factor LONGER. At either end of an arc it may lead to a point half a
    # step beyond the arc.
    most = (LONGER - 1) * (arcs + 2 * len(corners) * HULL * math.pi / 16)
    assert length - REACH - 1e-9 <= found <= length - REACH + most


def _maze(random: np.random.Generator, cells: int, edge: float) -> list[list[float]]:
    """Returns touching walls of a maze, in which exactly one path joins any two cells."""
    sides = [(i, j, k) for i in range(cells) for j in range(cells) for k in (0, 1)]
    sides = [each for each in sides if each[each[2]] + 1 < cells]
    part = np.arange(cells**2).reshape(cells, cells)
    walls = []
    for i, j, k in random.permutation(sides):
        one, other = part[i, j], part[i + 1 - k, j + k]
        if one != other:
            part[part == other] = one
            continue
        x, y = ((i + (1 - k / 2), j + (k + 1) / 2) - np.full(2, cells / 2)) * edge
        half = [T, edge / 2 + T]
        walls.append([x, y, 0.0, *(half[::-1] if k else half)])
    return walls


@pytest.mark.parametrize("seed", range(4))
def test_ways_through_a_maze_are_those_of_a_grid(seed: int) -> None:
    cells, edge = 4, 0.25
    random = np.random.default_rng(seed)
    walls = _maze(random, cells, edge)
    assert len(walls) == 9  # of 24 sides, all but the 15 that join the cells as a tree
    ends = (random.permutation(cells**2)[:10].reshape(5, 2)[..., None] // [cells, 1]) % cells
    for start, target in (ends + 0.5 - cells / 2) * edge:
        found = _shortest(list(start), list(target), walls, cells * edge)
        expected = _by_grid(cells * edge, start, target, np.array(walls))
        # The bounds are those of `test_ways_are_those_of_a_grid`. All corridors are 0.24 m wide, so
        # the grid closes none of them.
        assert found <= expected + 2 * CELL + SLACK
        assert expected <= 1.027 * found + 4 * CELL


def test_a_wall_far_from_the_straight_way_bars_the_detour() -> None:
    """A plate from -1.5 to 1 m, made longer by a second one up to 1.3 m, is a plate to 1.3 m."""
    ends = [-0.4, 0.0], [0.4, 0.0]
    longer = _shortest(*ends, [[0, -0.25, 0, 1e-9, 1.25], [0, 1.15, 0, 1e-9, 0.15]], side=4.0)
    whole = _shortest(*ends, [[0, -0.1, 0, 1e-9, 1.4]], side=4.0)
    assert longer == pytest.approx(whole, abs=1e-9)


def test_robots_of_an_arena_do_not_change_each_others_ways() -> None:
    """The results for one robot's path are kept for the next robot."""
    random = np.random.default_rng(5)
    walls = _maze(random, 4, 0.25)
    ends = (random.permutation(16).reshape(8, 2)[..., None] // [4, 1] % 4 - 1.5) * 0.25
    together = shortest_path.shortest(
        np.array([1.0]), ends[None, :, 0], ends[None, :, 1], np.array([walls]), HULL, REACH
    )
    alone = [_shortest(list(start), list(target), walls, 1.0) for start, target in ends]
    # The sums are the same, but a leg may be computed from its other end, which changes the last
    # bits.
    np.testing.assert_allclose(together[0], alone, rtol=1e-14)


@pytest.mark.parametrize("shut_in", ["start", "target"])
def test_no_way_leads_through_a_closed_cell_of_a_maze(shut_in: str) -> None:
    walls = _maze(np.random.default_rng(1), 4, 0.25)
    cell = [[0.125 + x, 0.125 + y, 0.0, *half] for x, y, half in (
        (0.125, 0, (T, 0.13)), (-0.125, 0, (T, 0.13)),
        (0, 0.125, (0.13, T)), (0, -0.125, (0.13, T)))]  # fmt: skip
    ends = [[0.125, 0.125], [-0.375, -0.375]]
    start, target = ends if shut_in == "start" else ends[::-1]
    assert math.isfinite(_shortest(start, target, walls, 1.0))
    assert _shortest(start, target, walls + cell, 1.0) == math.inf


# With whole centimetres, no gap between axis-parallel boxes is between 7.4 cm and 7.54 cm. These
# are the diameter of the disc and the diameter of the points around it. In a gap between these two,
# there may be a path that no points lead along.
_CM = st.integers(-50, 50).map(lambda x: x / 100)
_HALF = st.integers(1, 30).map(lambda x: x / 100)
_BOX = st.tuples(_CM, _CM, st.just(0.0), _HALF, _HALF).map(list)
_PLACE = st.tuples(_CM, _CM).map(list)


def _is_clear(place: list[float], boxes: list[list[float]]) -> bool:
    """Tells whether a disc at a place [2] is at least 1 mm from boxes [M, 5] of any yaw."""
    for x, y, yaw, *half in boxes:
        dx, dy = place[0] - x, place[1] - y
        u, v = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
        if math.hypot(max(abs(u) - half[0], 0), max(abs(v) - half[1], 0)) < HULL + 1e-3:
            return False
    return True


@given(start=_PLACE, target=_PLACE, boxes=st.lists(_BOX, max_size=5), more=_BOX)
def test_what_holds_of_any_way(
    start: list[float], target: list[float], boxes: list[list[float]], more: list[float]
) -> None:
    assume(_is_clear(start, [*boxes, more]) and _is_clear(target, [*boxes, more]))
    near = 1e-5  # m; small, so that start and target may be exchanged
    found = _shortest(start, target, boxes, 1.2, near)
    assert found >= math.dist(start, target) - near - 1e-12
    assert _shortest(target, start, boxes, 1.2, near) == pytest.approx(found, abs=2 * near)
    # A path around a corner is too long by at most the factor LONGER, and the points of another box
    # may shorten the path.
    assert LONGER * (_shortest(start, target, [*boxes, more], 1.2, near) + near) >= found


def test_no_way_leads_out_of_a_cage() -> None:
    cage = [[x, y, 0, *half] for x, y, half in (
        (0.3, 0, (0.02, 0.32)), (-0.3, 0, (0.02, 0.32)),
        (0, 0.3, (0.32, 0.02)), (0, -0.3, (0.32, 0.02)))]  # fmt: skip
    assert _shortest([0, 0], [0.8, 0.0], cage) == math.inf
    # A gap of more than two hulls in the cage lets the robot out.
    cage[0] = [0.3, 0.06, 0, 0.02, 0.30]
    cage[3] = [-0.16, -0.3, 0, 0.16, 0.02]
    assert 0.75 < _shortest([0, 0], [0.8, 0.0], cage) < 2.0


def test_walls_bar_the_way_too() -> None:
    """A plate from wall to wall has a gap 1 mm narrower, or 1 mm wider, than the hull."""
    for gap, there in ((2 * HULL - 1e-3, False), (2 * HULL + 1e-3, True)):
        plate = [0.0, -gap / 2, 0.0, 0.02, 0.5 - gap / 2]
        found = _shortest([-0.3, 0.0], [0.3, 0.0], [plate], side=1.0)
        assert math.isfinite(found) == there


def test_a_target_in_a_corner_is_out_of_reach() -> None:
    """The disc's centre can reach only (0.463, 0.463), which is 0.037 m sqrt(2) from the corner."""
    assert math.sqrt(2) * HULL > REACH
    assert _shortest([0.0, 0.0], [0.5, 0.5], [], side=1.0) == math.inf
    assert _shortest([0.0, 0.0], [0.5, 0.5], [[-0.3, 0, 0, 0.02, 0.1]], side=1.0) == math.inf


def test_walls_stop_the_straight_way() -> None:
    # The straight line to (0.498, 0.498) ends at 0.498 - 0.05 / sqrt(2) = 0.4626 m < 0.463 m.
    assert _shortest([0.0, 0.0], [0.498, 0.498], [], side=1.0) == pytest.approx(
        math.sqrt(2) * 0.498 - REACH
    )
    # Along the wall the straight line would end at y = 0.498 - 0.05 * 0.038 / 0.2036 = 0.4887 m.
    # The disc reaches at most y = 0.463 m, so its path ends where y = 0.463 m meets the circle
    # around the target.
    start, target = [0.4, 0.46], [0.2, 0.498]
    stop = 0.2 + math.sqrt(REACH**2 - (0.498 - 0.463) ** 2)
    assert _shortest(start, target, [], side=1.0) == pytest.approx(math.dist(start, [stop, 0.463]))
    # The robot is pressed into the wall and already at its target.
    assert _shortest([0.47, 0.0], [0.49, 0.0], [], side=1.0) == 0.0


CELL = 0.01  # m, of the grid


def _by_grid(side: float, start: np.ndarray, target: np.ndarray, boxes: np.ndarray) -> float:
    """Returns a path's length by Dijkstra's algorithm on a grid with 16 neighbours per cell, m."""
    axis = np.arange(-side / 2 + CELL / 2, side / 2, CELL)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    free = np.maximum(np.abs(x), np.abs(y)) <= side / 2 - HULL
    for cx, cy, yaw, hx, hy in boxes:
        u = np.cos(yaw) * (x - cx) + np.sin(yaw) * (y - cy)
        v = np.cos(yaw) * (y - cy) - np.sin(yaw) * (x - cx)
        apart = np.hypot(np.maximum(np.abs(u) - hx, 0), np.maximum(np.abs(v) - hy, 0))
        free &= apart >= HULL
    number = np.arange(x.size).reshape(x.shape)
    links = []
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1)):
        a = free & np.roll(free, (-i, -j), (0, 1))
        a[-i:] = False
        a[:, -j:] &= j <= 0
        if j < 0:
            a[:, :-j] = False
        links.append((number[a], np.roll(number, (-i, -j), (0, 1))[a], CELL * math.hypot(i, j)))
    rows, columns = (np.concatenate([link[k] for link in links]) for k in (0, 1))
    lengths = np.concatenate([np.full(len(link[0]), link[2]) for link in links])
    graph = coo_array((lengths, (rows, columns)), shape=(x.size, x.size)).tocsr()
    begin = np.argmin(np.hypot(x - start[0], y - start[1]) + 9 * ~free)
    far = dijkstra(graph, directed=False, indices=begin)
    there = (np.hypot(x - target[0], y - target[1]) <= REACH) & free
    return float(far[there.ravel()].min(initial=np.inf))


def test_ways_are_those_of_a_grid() -> None:
    random = np.random.default_rng(3)
    longer, cut_off, disagreements, close = 0, 0, 0, []
    for _ in range(40):
        boxes = random.uniform(-0.45, 0.45, (9, 5))
        boxes[:, 2] *= 4.0
        boxes[:, 3:] = random.uniform(0.02, 0.2, (9, 2))
        start, target = _free_places(random, boxes)
        found = _shortest(list(start), list(target), boxes.tolist(), 1.2)
        expected = _by_grid(1.2, start, target, boxes)
        straight = max(math.dist(start, target) - REACH, 0.0)
        if math.isinf(found) or math.isinf(expected):
            cut_off += found == expected
            disagreements += found != expected
            continue
        # Paths along 16 directions are up to 2.7 % longer. The grid shifts either end by up to 0.7
        # cells, and may close a narrow passage that is open to the disc.
        assert found <= expected + 2 * CELL + SLACK
        assert found >= straight - 1e-9
        longer += found > straight + 0.01
        close.append(expected <= 1.027 * found + 4 * CELL)
    assert np.mean(close) > 0.8  # the seed is fixed; the measured share is 0.9
    assert longer > 8
    assert cut_off > 0
    # The seed is fixed. Two passages, narrower than a cell, are closed on the grid only.
    assert disagreements <= 2


def _free_places(random: np.random.Generator, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draws two places in the arena where the disc meets no box."""
    while True:
        place = random.uniform(-0.55, 0.55, (2, 2))
        if all(_is_clear(list(each), boxes.tolist()) for each in place):
            return place[0], place[1]
