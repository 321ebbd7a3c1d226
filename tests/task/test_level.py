"""Checks ten thousand levels of the shipped stages with geometry of the tests' own."""

import math
from collections.abc import Callable
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import ndimage, stats

from swarmjax.config import ConfigError
from swarmjax.sim import gaps
from swarmjax.task import level
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.placement import LATTICE, MARGIN, UNITS
from swarmjax.task.stage_config import StageConfig, smallest_side

STAGES = (
    StageConfig(name="s1", robots=2, side=0.5),
    StageConfig(name="s2", robots=2, side=0.7),
    StageConfig(name="s3", robots=3, side=0.7, obstacles=1),
    StageConfig(name="s4", robots=3, side=1.0, obstacles=2),
    StageConfig(name="s5", robots=5, side=1.0, obstacles=2),
    StageConfig(name="s6", robots=5, side=1.2, obstacles=3),
    StageConfig(name="expanded", robots=5, side=1.5, obstacles=3),
)
NAMES = [stage.name for stage in STAGES]
PER_STAGE = 1430  # 10,010 in all
HULL, REACH = 0.037, 0.05  # m: radius of the robot; distance at which it has arrived
WIDTH = 2 * HULL
PASSAGE = 0.10  # m, between obstacles, and between an obstacle and a wall
SPACING = Spacing(robots=5, obstacles=4, hull_radius=HULL, target_radius=REACH)
# Distances are kept in whole units and compared in float32, which adds 1e-6 m at most.
ROUNDING = 1e-6

Draw = Callable[[np.ndarray, task_stage.Stage], Level]


@pytest.fixture(scope="session")
def draw() -> Draw:
    """Returns a function that draws levels [N] with JAX.

    It takes uniform numbers [N, ...] and stages [N].
    """
    sample = jax.jit(jax.vmap(lambda u, stage: level.sample(u, stage, SPACING, jnp)))

    def drawn(uniforms: np.ndarray, stage: task_stage.Stage) -> Level:
        return jax.tree.map(np.asarray, sample(uniforms, stage))

    return drawn


def _uniforms(seed: int, count: int = PER_STAGE) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.random((count, level.uniform_count(SPACING)), dtype=np.float32)


def _repeated(stage: StageConfig, count: int = PER_STAGE) -> task_stage.Stage:
    return task_stage.select(task_stage.stack([stage]), np.zeros(count, int))


@pytest.fixture(scope="session")
def levels(draw: Draw) -> dict[str, Level]:
    """Returns `PER_STAGE` levels of each stage."""
    return {
        stage.name: draw(_uniforms(seed), _repeated(stage)) for seed, stage in enumerate(STAGES)
    }


# Each stage is compiled on its own, so only the smallest and the largest are not slow.
@pytest.fixture(
    params=[
        pytest.param(stage, marks=[pytest.mark.slow] * (stage.name in NAMES[1:6]))
        for stage in STAGES
    ],
    ids=NAMES,
)
def stage(request: pytest.FixtureRequest) -> StageConfig:
    return request.param


@pytest.fixture
def drawn(stage: StageConfig, levels: dict[str, Level]) -> Level:
    return levels[stage.name]


def _between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the distances [N, I, J] between points [N, I, 2] and [N, J, 2]."""
    return np.linalg.norm(first[:, :, None] - second[:, None], axis=-1)


def _among(points: np.ndarray) -> np.ndarray:
    """Returns the distances [N, I, I] between points [N, I, 2], inf from a point to itself."""
    apart = _between(points, points)
    apart[:, np.eye(points.shape[1], dtype=bool)] = np.inf
    return apart


def _to_boxes(place: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Returns signed distances [N, I, M] from points [N, I, 2] to turned boxes [N, M, 5]."""
    offset = place[:, :, None] - box[:, None, :, :2]
    cos, sin = np.cos(box[:, None, :, 2]), np.sin(box[:, None, :, 2])
    along = np.abs(cos * offset[..., 0] + sin * offset[..., 1]) - box[:, None, :, 3]
    across = np.abs(cos * offset[..., 1] - sin * offset[..., 0]) - box[:, None, :, 4]
    outside = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    return outside + np.minimum(np.maximum(along, across), 0.0)


def _corners(box: np.ndarray) -> np.ndarray:
    """Returns the corners [N, M, 4, 2] of turned boxes [N, M, 5]."""
    sign = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    x, y = np.moveaxis(sign * box[..., None, 3:], -1, 0)
    cos, sin = np.cos(box[..., 2:3]), np.sin(box[..., 2:3])
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return box[..., None, :2] + turned


def _box_gaps(box: np.ndarray) -> np.ndarray:
    """Returns distances [N, M, M] between turned boxes [N, M, 5] that do not overlap.

    The distance of a box to itself is inf.

    Two rectangles that do not overlap are nearest at a corner of one of them.
    """
    count = box.shape[1]
    corners = _corners(box).reshape(len(box), -1, 2)
    near = _to_boxes(corners, box).reshape(len(box), count, 4, count).min(axis=2)
    near[:, np.eye(count, dtype=bool)] = np.inf
    return np.minimum(near, np.swapaxes(near, 1, 2))


# --- NumPy and JAX


def test_numpy_and_jax_draw_the_same_levels(stage: StageConfig, drawn: Level) -> None:
    single = task_stage.select(task_stage.stack([stage]), 0)
    uniforms = _uniforms(STAGES.index(stage))
    by_numpy = [level.sample(u, single, SPACING, np) for u in uniforms]
    expected = Level(*map(np.stack, zip(*by_numpy, strict=True)))
    for name in ("side", "present", "obstacle_present"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(expected, name), err_msg=name)
    np.testing.assert_array_equal(drawn.obstacle[..., 3:], expected.obstacle[..., 3:])
    for name in ("start", "target", "obstacle"):
        mine, theirs = getattr(drawn, name)[..., :2], getattr(expected, name)[..., :2]
        np.testing.assert_array_equal(mine, theirs, err_msg=name)
    # Angles are float32 products, which XLA may round differently: 5e-7 rad is 2 ulp at pi.
    np.testing.assert_allclose(drawn.start[..., 2], expected.start[..., 2], atol=5e-7)
    np.testing.assert_allclose(drawn.obstacle[..., 2], expected.obstacle[..., 2], atol=5e-7)
    assert expected.start.dtype == expected.target.dtype == expected.obstacle.dtype == np.float32


# --- an arena whose side is drawn from a range

RANGE = StageConfig(name="range", robots=3, side=(0.8, 1.3), obstacles=2)


def test_a_side_is_drawn_from_its_range(draw: Draw) -> None:
    side = draw(_uniforms(20), _repeated(RANGE)).side
    # The bounds are the whole units between 0.8 m (3276.8) and 1.3 m (5324.8).
    np.testing.assert_array_equal(side * UNITS, np.round(side * UNITS))
    assert (side * UNITS >= 3277).all()
    assert (side * UNITS <= 5324).all()
    # A fair sampler fails at a given seed with probability 1e-5. The seed was chosen before the
    # result was known.
    assert stats.kstest((side * UNITS - 3277 + 0.5) / 2048, "uniform").pvalue > 1e-5


def test_both_ends_of_a_range_are_drawn(draw: Draw) -> None:
    ends = 1.0 + np.array([0, 3]) / UNITS
    narrow = StageConfig(name="narrow", robots=1, side=(ends[0], ends[1]))
    side = draw(_uniforms(21), _repeated(narrow)).side
    counts = np.bincount(np.round((side - 1.0) * UNITS).astype(int))
    assert stats.chisquare(counts).pvalue > 1e-5  # as above
    assert len(counts) == 4


def test_numpy_draws_the_same_side(draw: Draw) -> None:
    found, single = draw(_uniforms(22), _repeated(RANGE)), task_stage.stack([RANGE])
    for i, uniforms in enumerate(_uniforms(22)[:200]):
        expected = level.sample(uniforms, task_stage.select(single, 0), SPACING, np)
        assert expected.side == found.side[i]
        assert expected.side.dtype == np.float32
        np.testing.assert_array_equal(expected.target, found.target[i])


def test_nothing_else_depends_on_the_range(draw: Draw) -> None:
    """Compares each level with the level of a stage whose only side is the drawn one."""
    found, stage = draw(_uniforms(23), _repeated(RANGE)), _repeated(RANGE)
    assert len(np.unique(found.side)) > 1000
    same = draw(_uniforms(23), stage._replace(side=found.side, largest_side=found.side))
    jax.tree.map(np.testing.assert_array_equal, found, same)
    fixed = draw(_uniforms(23), stage._replace(largest_side=stage.side))
    assert (fixed.side == np.float32(0.8)).all()
    np.testing.assert_array_equal(fixed.seed, found.seed)


def test_nothing_overlaps_in_an_arena_of_any_size(draw: Draw) -> None:
    found = draw(_uniforms(24), _repeated(RANGE))
    assert found.obstacle_present[:, :2].all()
    _assert_nothing_overlaps(found, RANGE.robots, RANGE.obstacles)


# --- what a level contains, and where


def test_the_stage_says_how_many_there_are(stage: StageConfig, drawn: Level) -> None:
    robots = [True] * stage.robots + [False] * (SPACING.robots - stage.robots)
    boxes = [True] * stage.obstacles + [False] * (SPACING.obstacles - stage.obstacles)
    assert (drawn.present == robots).all()
    assert (drawn.obstacle_present == boxes).all()
    assert (drawn.side == np.float32(stage.sides[0])).all()
    assert (drawn.obstacle[..., 3:] == np.float32(0.5 * stage.obstacle_size)).all()


def test_what_is_absent_waits_outside_at_a_place_of_its_own(
    stage: StageConfig, drawn: Level
) -> None:
    robots, boxes = drawn.start[:, stage.robots :], drawn.obstacle[:, stage.obstacles :]
    # The largest arena is 4 m wide and its walls are 0.1 m thick.
    assert (np.abs(robots[..., :2]).max(axis=-1) - HULL > 2.1).all()
    reach = np.hypot(boxes[..., 3], boxes[..., 4])
    assert (np.abs(boxes[..., :2]).max(axis=-1) - reach > 2.1).all()
    assert (_among(robots[..., :2]) > WIDTH).all()
    assert (_to_boxes(robots[..., :2].astype(float), drawn.obstacle) > HULL).all()
    # Absent robots stand on their targets, so none looks as if it were on its way.
    np.testing.assert_array_equal(drawn.target[:, stage.robots :], robots[..., :2])


def _assert_nothing_overlaps(drawn: Level, robots: int, obstacles: int) -> None:
    """Asserts that robots at starts or targets overlap no robot, obstacle or wall."""
    start, target = drawn.start[:, :robots, :2], drawn.target[:, :robots]
    half = 0.5 * drawn.side[:, None]
    box = drawn.obstacle[:, :obstacles].astype(np.float64)
    for place in (start, target):
        assert (_among(place) > WIDTH).all()
        assert (np.abs(place).max(axis=-1) < half - HULL).all()
        assert (_to_boxes(place, box) > HULL).all()
    # No robot starts in the zone of arrival of any target, its own or another robot's.
    assert (_between(start, target) > REACH).all()


def test_nothing_overlaps(stage: StageConfig, drawn: Level) -> None:
    _assert_nothing_overlaps(drawn, stage.robots, stage.obstacles)


def test_a_robot_passes_between_obstacles_and_walls(stage: StageConfig, drawn: Level) -> None:
    box = drawn.obstacle[:, : stage.obstacles].astype(np.float64)
    assert (_box_gaps(box) >= PASSAGE - ROUNDING).all()
    reach = np.abs(_corners(box)).max(axis=(-2, -1))
    assert (0.5 * stage.sides[0] - reach >= PASSAGE - ROUNDING).all()


def test_targets_are_so_far_apart_that_a_robot_passes_between_two_parked_ones(
    stage: StageConfig, drawn: Level
) -> None:
    target = drawn.target[:, : stage.robots]
    assert (_among(target) >= 2 * REACH + 2 * WIDTH - ROUNDING).all()
    box = drawn.obstacle[:, : stage.obstacles].astype(np.float64)
    assert (_to_boxes(target, box) >= REACH + HULL + WIDTH - ROUNDING).all()


def test_levels_fill_the_arena(stage: StageConfig, drawn: Level) -> None:
    # One place per level makes the counts independent. Mirror images are equally likely.
    for place in (drawn.start[:, 0, :2], drawn.target[:, 0]):
        quadrant = 2 * (place[:, 0] > 0) + (place[:, 1] > 0)
        counts = np.bincount(quadrant, minlength=4)
        # A fair sampler fails at a given seed with probability 1e-5.
        assert stats.chisquare(counts).pvalue > 1e-5, counts
        # The centre of a robot keeps a distance of the hull's radius plus 2 cm, rounded up, from
        # every wall. What remains is less than one step of the lattice.
        rim = 0.5 * stage.sides[0] - HULL - MARGIN - np.array([place.max(), -place.min()])
        assert (rim < stage.sides[0] / LATTICE + 1 / UNITS).all()
        # Every ninth of the arena is used. The middle ninth has the fewest robots, because the
        # obstacle of a small arena must stand there: a fifth of an equal share was seen (34 of
        # 159), 3 standard deviations of the count above the bound. The seeds are fixed.
        third = np.clip(np.floor(3 * (place / (stage.sides[0] - 2 * HULL - 0.04) + 0.5)), 0, 2)
        cells = np.bincount((3 * third[:, 0] + third[:, 1]).astype(int), minlength=9)
        assert (cells > 0.1 * PER_STAGE / 9).all(), cells


def test_headings_point_everywhere(stage: StageConfig, drawn: Level) -> None:
    yaw = drawn.start[:, : stage.robots, 2].reshape(-1)
    assert (np.abs(yaw) <= np.float32(math.pi)).all()
    turn = drawn.obstacle[:, : stage.obstacles, 2].reshape(-1)
    assert ((turn >= 0.0) & (turn <= 0.5 * math.pi)).all()
    counts = np.histogram(yaw, bins=8, range=(-math.pi, math.pi))[0]
    # A fair sampler fails at a given seed with probability 1e-5.
    assert stats.chisquare(counts).pvalue > 1e-5, counts
    if turn.size:
        counts = np.histogram(turn, bins=4, range=(0.0, 0.5 * math.pi))[0]
        assert stats.chisquare(counts).pvalue > 1e-5, counts  # as above


# --- every target stays reachable in any order of arrival

CELL = 0.01  # m, of the first flood
FINE_CELL = 0.0025  # m, of the second


class _Flood:
    """A grid of places for a robot's centre among the walls and obstacles of levels [N].

    A cell is free if its centre keeps the robot's radius and half a cell from walls and obstacles.
    The straight line between the centres of two free neighbours is then free too, so a path over
    free cells is a path for the robot.
    """

    def __init__(self, drawn: Level, obstacles: int, cell: float) -> None:
        self.cell, self.side = cell, float(drawn.side[0])
        axis = np.arange(0.5 * cell, self.side, cell, dtype=np.float32) - 0.5 * self.side
        self.grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        inside = np.abs(self.grid).max(axis=-1) <= 0.5 * self.side - HULL - 0.5 * cell
        points = self.grid.reshape(1, -1, 2)
        self.free = np.broadcast_to(inside, (len(drawn.side), *inside.shape)).copy()
        for box in np.moveaxis(drawn.obstacle[:, :obstacles], 1, 0):
            far = _to_boxes(points, box[:, None])[..., 0] >= HULL + 0.5 * cell
            self.free &= far.reshape(self.free.shape)

    def squared(self, centre: np.ndarray) -> np.ndarray:
        """Returns the squared distances [N, X, Y] from all cells to points [N, 2]."""
        offset = self.grid[None] - centre[:, None, None]
        return offset[..., 0] ** 2 + offset[..., 1] ** 2

    def reaches(self, start: np.ndarray, goal: np.ndarray, blocked: np.ndarray) -> np.ndarray:
        """Returns whether a path leads from start [N, 2] to a cell of goal [N, X, Y], [N] bool."""
        plane = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]])
        structure = np.stack([0 * plane, plane, 0 * plane])  # connects no two levels
        label = np.zeros(self.free.shape, np.int32)
        ndimage.label(self.free & ~blocked, structure=structure, output=label)
        x, y = np.floor((start + 0.5 * self.side) / self.cell).astype(int).T
        mine = label[np.arange(len(label)), x, y]
        return (mine > 0) & ((label == mine[:, None, None]) & goal).any(axis=(1, 2))


def _cut_off(drawn: Level, stage: StageConfig) -> list[tuple[int, int]]:
    """Returns levels and robots that have no path while a wide disc closes each other target.

    The disc holds all places that a robot parked within `REACH` of its target closes to another.
    """
    found = []
    for first in range(0, PER_STAGE, 130):
        some = Level(*(field[first : first + 130] for field in drawn))
        flood = _Flood(some, stage.obstacles, CELL)
        squared = [flood.squared(some.target[:, i]) for i in range(stage.robots)]
        discs = np.stack([s < (REACH + WIDTH + 0.5 * CELL) ** 2 for s in squared])
        count = discs.sum(axis=0, dtype=np.int8)
        for i in range(stage.robots):
            goal, blocked = squared[i] <= REACH**2, count > discs[i]
            reached = flood.reaches(some.start[:, i, :2], goal, blocked)
            found += [(first + int(n), i) for n in np.flatnonzero(~reached)]
    return found


def _is_cut_off_by_one(drawn: Level, stage: StageConfig, index: int, robot: int) -> bool:
    """Returns whether the closed disc of a single other target cuts off a robot of one level."""
    one = Level(*(field[index : index + 1] for field in drawn))
    flood = _Flood(one, stage.obstacles, FINE_CELL)
    goal = flood.squared(one.target[:, robot]) <= REACH**2
    limit = (REACH + WIDTH + 0.5 * FINE_CELL) ** 2
    others = [i for i in range(stage.robots) if i != robot]
    return not all(
        flood.reaches(one.start[:, robot, :2], goal, flood.squared(one.target[:, i]) < limit)[0]
        for i in others
    )


@pytest.mark.slow
def test_every_target_stays_reachable_in_any_order_of_arrival(
    stage: StageConfig, drawn: Level
) -> None:
    # The first flood closes, all at once, every place that any of the other robots could close by
    # parking. This is more than parked robots can close: the discs of two targets overlap as soon
    # as half a cell is added, yet two robots, each at one place, leave a way between them. (Tests
    # above assert this, also for a robot and an obstacle.) By Janiszewski's theorem, closed sets
    # that meet only in the walls cut nothing off together unless one of them cuts it off with the
    # walls. For robots that the first flood does not reach, one disc at a time is therefore enough.
    suspects = _cut_off(drawn, stage)
    assert len(suspects) < 0.01 * PER_STAGE  # otherwise the first flood proves little
    assert not [s for s in suspects if _is_cut_off_by_one(drawn, stage, *s)]


# --- any stage that the config accepts

ROOMS = st.floats(0.0, 1.0, allow_subnormal=False)


@settings(max_examples=40)
@given(
    robots=st.integers(1, SPACING.robots),
    obstacles=st.integers(0, SPACING.obstacles),
    size=st.floats(0.02, 0.3),
    room=ROOMS,
    seed=st.integers(0, 2**32 - 1),
)
@pytest.mark.slow
def test_nothing_overlaps_on_any_stage_that_is_accepted(
    draw: Draw, robots: int, obstacles: int, size: float, room: float, seed: int
) -> None:
    roomy = StageConfig(
        name="any", robots=robots, side=4.0, obstacles=obstacles, obstacle_size=size
    )
    least = max(0.4, smallest_side(roomy))
    side = least + room**4 * (4.0 - least)  # mostly tight
    try:
        stage = StageConfig(
            name="any", robots=robots, side=side, obstacles=obstacles, obstacle_size=size
        )
    except ConfigError:
        assume(False)
        return
    found = draw(_uniforms(seed, 64), _repeated(stage, 64))
    assert (found.present.sum(axis=-1) == robots).all()
    assert (found.obstacle_present.sum(axis=-1) <= obstacles).all()  # some obstacles may not fit
    _assert_nothing_overlaps(found, robots, obstacles)
    for i in range(64):
        box = found.obstacle[i : i + 1, found.obstacle_present[i]].astype(np.float64)
        assert (_box_gaps(box) >= PASSAGE - ROUNDING).all()
        corners = np.abs(_corners(box)).max(initial=0.0)
        assert 0.5 * side - corners >= PASSAGE - ROUNDING or not box.size


def test_gaps_agree_with_this_geometry(levels: dict[str, Level]) -> None:
    drawn = levels["s6"]
    for i in range(50):
        found = gaps.gaps(drawn.start[i], drawn.side[i], drawn.obstacle[i], HULL, np)
        place = drawn.start[i : i + 1, :, :2]
        expected = [
            _among(place)[0].min(axis=-1) - WIDTH,
            _to_boxes(place, drawn.obstacle[i : i + 1])[0].min(axis=-1) - HULL,
            0.5 * drawn.side[i] - np.abs(place[0]).max(axis=-1) - HULL,
        ]
        # 1e-5 m covers float32 at 5 m, where absent things are parked.
        np.testing.assert_allclose(found, np.stack(expected, axis=-1), atol=1e-5)


def test_a_seed_has_16_bits_of_each_of_two_numbers() -> None:
    drawn = SimpleNamespace(seed=np.array([0.75, 1.0 - 2.0**-16], np.float32))
    assert level._seed(drawn, np) == 0xC000FFFF  # type: ignore[arg-type]
