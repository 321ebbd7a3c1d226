"""Tests `rub_sweeps`: contacts worked out by hand, its copy of the solver, and its refusals."""

import functools
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks import rub_sweeps
from swarmjax.config import ConfigError
from swarmjax.sim import model
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.fast import discs, rubbing_jax, rubbing_warp
from swarmjax.sim.fast.discs import DiscRobots, Discs, Rubbing

ROBOTS, STATES, MOST = 5, 64, 400
MOBILITY, AGILITY = 1.0 / 0.16, 1.0 / 1.06e-4  # 1 / kg and 1 / (kg m^2) of an e-puck


def _states(place: np.ndarray, free: np.ndarray, side: float) -> rub_sweeps.States:
    """Returns states of robots [S, R, 3] at rest, with friction 1 and without obstacles."""
    count, robots, _ = place.shape
    size = model.ArenaSize(robots, 0, 0.05)
    built = model.build(RobotConfig(hull_friction=1.0), size, 0.032).compile()
    fixed = discs.load(built, model.ids(built, size), 0.037, rubbing_jax.push_apart)
    weight = built.body_invweight0[model.ids(built, size).hull_body, 0]
    each = np.ones((count, robots), np.float32)
    rubbing = Rubbing(np.float32(AGILITY) * each, np.ones(count, np.float32))
    still = np.zeros((count, robots, 3), np.float32)
    mass = np.float32(MOBILITY) * each, weight.astype(np.float32) * each
    given: Any = DiscRobots(
        place.astype(np.float32), still, free.astype(np.float32), still, *mass, rubbing
    )
    sides = np.full(count, side, np.float32)
    obstacle = np.zeros((count, 0, 5), np.float32)
    return rub_sweeps.States(fixed._replace(sweeps=MOST), given, sides, obstacle, count)


@pytest.fixture(scope="module")
def jam() -> rub_sweeps.States:
    """Returns states of five robots in an arena of 0.25 m, where all press others or walls."""
    random = np.random.default_rng(7)
    place = random.uniform(-0.5, 0.5, (STATES, ROBOTS, 3)) * [0.25, 0.25, 6.0]
    free = random.normal(0.0, 3.0, (STATES, ROBOTS, 3)) * [1.0, 1.0, 20.0]
    return _states(place, free, 0.25)


@pytest.fixture(scope="module")
def at_rest(jam: rub_sweeps.States) -> np.ndarray:
    """Returns the accelerations of the jam, converged in float64."""
    contacts = rub_sweeps.contacts_of(jam)
    return rub_sweeps.search(contacts, rub_sweeps.DESIGNS["plain"], 2000, np.float64, 1e-13)[0]


def _off(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Returns each state's largest error, as a share of its largest expected number."""
    return np.abs(found - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))


def test_one_robot_against_a_wall_comes_to_rest_where_the_balance_of_forces_says() -> None:
    # The robot is a millimetre inside the east wall, where the impedance d has its maximum of 0.95,
    # and is driven into the wall with 2 m/s^2. The spring demands the acceleration k d depth away
    # from the wall, with k = 1 / (0.95 * 2 dt)^2. The force is (k d depth + 2) / (1 / m + R), with
    # R = (1 - d) / d * weight. Here the weight is 2 / 3 / m, the mean over three axes, one of which
    # cannot move.
    place, free = np.array([[[0.5 - 0.037 + 1e-3, 0.0, 0.0]]]), np.array([[[2.0, 0.0, 0.0]]])
    contacts = rub_sweeps.contacts_of(_states(place, free, 1.0))
    asked = 0.95 * 1e-3 / (0.95 * 0.064) ** 2
    give = 0.05 / 0.95 * 2.0 / 3.0
    expected = 2.0 - (asked + 2.0) / (1.0 + give)
    found, sweeps = rub_sweeps.search(contacts, rub_sweeps.DESIGNS["plain"], 400)
    # The depth is a difference of float32 numbers near 0.5: it is off by 3e-8 of 1e-3.
    assert found[0, 0, 0] == pytest.approx(expected, rel=1e-4)
    assert sweeps.tolist() == [2]  # the first sweep converges, the second sees no change


@pytest.mark.parametrize("name", rub_sweeps.DESIGNS)
def test_all_designs_come_to_rest_in_one_place(
    name: str, jam: rub_sweeps.States, at_rest: np.ndarray
) -> None:
    contacts = rub_sweeps.contacts_of(jam)
    found, sweeps = rub_sweeps.search(contacts, rub_sweeps.DESIGNS[name], 2000)
    assert sweeps.max() < 2000
    # Sweeps end at a change of 1e-6. Their changes may shrink by only a few per cent per sweep, and
    # forces may cancel, so the error is larger than that.
    assert _off(found, at_rest).max() < 1e-3


def test_the_solver_takes_as_many_sweeps_as_its_twin(jam: rub_sweeps.States) -> None:
    contacts = rub_sweeps.contacts_of(jam)
    _, expected = rub_sweeps.search(contacts, rub_sweeps.DESIGNS["leaps-2"], MOST)
    _, found = rub_sweeps.built(jam)
    # The solver and its copy round differently, and a leap multiplies the difference. The means are
    # over 64 states.
    assert found.mean() == pytest.approx(expected.mean(), rel=0.1)


@pytest.mark.parametrize("solver", [rubbing_jax, rubbing_warp])
def test_solvers_are_at_rest_where_plain_sweeps_are_far_from_it(
    solver: Any, jam: rub_sweeps.States, at_rest: np.ndarray
) -> None:
    # Solvers leap only in the first half of the sweeps.
    few: Discs = jam.discs._replace(sweeps=120)
    solve = jax.jit(jax.vmap(functools.partial(solver.push_apart, few)))
    found = np.asarray(solve(jam.robots, jam.side, jam.obstacle))
    plain, _ = rub_sweeps.search(
        rub_sweeps.contacts_of(jam), rub_sweeps.DESIGNS["plain"], few.sweeps
    )
    # The solvers' measured error is 3e-5, since they stop at changes of 1e-6 that shrink slowly.
    # Plain sweeps have an error of 3.5e-3.
    assert _off(found, at_rest).max() < 1e-4
    assert _off(plain, at_rest).max() > 1e-3


def test_hulls_that_are_grazed_at_speed_come_to_rest() -> None:
    # These three of 20,000 crowds did not come to rest while any change above 1e-6 of a push
    # counted. Their pushes are so small that the rounding of accelerations of 100 m/s^2 exceeds
    # such a change.
    random, shape = np.random.default_rng(5), (20_000, ROBOTS, 3)
    rows, turn = [10062, 10658, 14805], [1.0, 1.0, 10.0]
    place = random.uniform(-0.5, 0.5, shape) * [0.6, 0.6, 6.0]
    free = random.normal(0.0, 3.0, shape) * [1.0, 1.0, 20.0]
    rate = (random.normal(0.0, 0.1, shape) * turn).astype(np.float32)
    before = (random.normal(0.0, 3.0, shape) * [1.0, 1.0, 20.0]).astype(np.float32)
    states = _states(place[rows], free[rows], 0.6)
    moving: Any = states.robots._replace(rate=rate[rows], before=before[rows])
    _, sweeps = rub_sweeps.built(states._replace(robots=moving))
    assert sweeps.max() < 50


def test_sweeps_of_a_warp_are_those_of_its_slowest_arena() -> None:
    sweeps = np.zeros(128, int)
    sweeps[[3, 40, 127]] = 10, 30, 60
    ones = np.ones((128, 1, 3))
    off = ones * 1.0
    off[5] = 1.5
    found = rub_sweeps.figures(sweeps, off, ones, np.arange(128) < 100, 64)
    assert found["sweeps_of_warp"] == (10 + 30 + 0 + 60) / 4
    assert found["sweeps_of_step"] == (30 + 60) / 2
    assert found["off_most"] == 0.5


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("designs=magic", "designs has 'magic': give some of plain"),
        ("arenas=104", "arenas is 104: give a multiple of 32"),
        ("robot.hull_friction=0", "discs with friction"),
        ("sim.solver=mjx", "discs with friction"),
    ],
)
def test_what_cannot_be_measured_is_refused(word: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        rub_sweeps.main([word])


@pytest.mark.slow
def test_a_line_of_a_stage() -> None:
    settings = rub_sweeps.RubSweepsConfig(stages=("s6",), designs=("plain", "built"))
    words = ["arenas=32", "sim.max_robots=5"]
    plain, built = rub_sweeps.results(settings, words, steps=24)
    assert (plain["design"], built["design"]) == ("plain", "built")
    assert plain["states"] == built["states"] == 32
    assert plain["sweeps_mean"] >= built["sweeps_mean"] > 0.0
