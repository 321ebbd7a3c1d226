"""Tests that cells list the same contacts as all pairs of robots, in the same order."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp as wp
from jax import Array

from swarmjax.sim import engine
from swarmjax.sim.fast import contacts_warp, gaps_warp, planar_warp, rubbing_warp
from swarmjax.sim.fast.discs import DiscRobots, Discs
from swarmjax.sim.fast.gaps_warp import WarpArena
from swarmjax.task import level

engine.start_warp()
RADIUS, ROOM = np.float32(0.037), 2000  # m, contacts of an arena
CELL = gaps_warp.CELL * RADIUS
NUMBERS = jnp.asarray(np.array([RADIUS, *np.ones(10)], np.float32))
Scene = Callable[[np.random.Generator, int, int], np.ndarray]


@wp.func
def _count(arena: WarpArena, first: int) -> None:
    """Counts the contacts of a lane."""
    k, count = wp.int32(first), wp.int32(0)
    while k >= 0:
        count += 1
        k = arena.after[k, arena.index]
    arena.total[0] = wp.vec3(float(count), 0.0, 0.0)


ALL_PAIRS = contacts_warp.kernels_of(_count)[0]


def _by_pairs(place: Array, side: Array, obstacle: Array) -> tuple[Array, Array]:
    """Returns the number of contacts [A], and their rows [2, K, A, 4]."""
    arenas, robots = place.shape[:2]
    motion = jnp.zeros((arenas, 5, robots, 3)).at[:, 0].set(place)
    given = motion, side, obstacle, NUMBERS
    shapes = {"contact": (2, ROOM, arenas), "total": (arenas, robots)}
    shapes |= {"island": (arenas, robots), "after": (ROOM, arenas)}
    call = wp.jax_kernel(ALL_PAIRS, num_outputs=4)
    contact, total, *_ = call(*given, launch_dims=(arenas, 1), output_dims=shapes)
    return total[:, 0, 0].astype(int), contact


def _scattered(random: np.random.Generator, arenas: int, robots: int) -> np.ndarray:
    """Returns places in and around arenas, a third of them with robots that overlap."""
    side = 0.06 * np.sqrt(robots) * random.choice([1.0, 3.0, 10.0], arenas)
    return random.uniform(-0.5, 0.5, (arenas, robots, 2)) * side[:, None, None]


def _on_borders(random: np.random.Generator, arenas: int, robots: int) -> np.ndarray:
    """Returns places on the borders of cells, or one float32 beside them."""
    far = max(3, round(0.7 * np.sqrt(robots)))
    border = (random.integers(-far, far, (arenas, robots, 2)) * CELL).astype(np.float32)
    towards = random.choice([-np.inf, 0.0, np.inf], border.shape)
    return np.where(towards == 0.0, border, np.nextafter(border, towards.astype(np.float32)))


def _touching(random: np.random.Generator, arenas: int, robots: int) -> np.ndarray:
    """Returns places in a row, a hull's diameter apart or one float32 more or less."""
    apart = np.full((arenas, robots), 2.0 * RADIUS, np.float32)
    ways = random.choice([-np.inf, 0.0, np.inf], apart.shape).astype(np.float32)
    x = np.where(ways == 0.0, apart, np.nextafter(apart, ways)).cumsum(axis=1, dtype=np.float32)
    x -= x[:, robots // 2 :][:, :1]
    row = random.uniform(-0.5, 0.5, (arenas, 1)) + 0.0 * x
    return random.permuted(np.stack([x, row], axis=-1), axis=1)


def _parked(random: np.random.Generator, arenas: int, robots: int) -> np.ndarray:
    """Returns scattered places, with some robots absent, and the last ones absurdly far away."""
    place = _scattered(random, arenas, robots)
    away = level.PARKING + level.PARKING_SPACING * np.arange(robots)
    absent = random.random((arenas, robots)) < 0.3
    place[absent] = np.stack([away, away * 0 + level.PARKING], -1)[np.nonzero(absent)[1]]
    place[:, -4:] = random.choice([-1e9, -3e3, 3e3, 1e9], (arenas, 1, 2))
    return place


SCENES = [_scattered, _on_borders, _touching, _parked]


def _boxes(random: np.random.Generator, arenas: int, obstacles: int, wide: float) -> np.ndarray:
    """Returns obstacles [A, M, 5]: most are small, and some are longer than the grid is wide."""
    box = random.uniform(-1.0, 1.0, (arenas, obstacles, 5)) * [wide, wide, 4.0, 1.0, 1.0]
    box[..., 3:] = np.exp(2.5 * box[..., 3:] - 3.0)
    return box


def _check(scene: Scene, arenas: int, robots: int, obstacles: int) -> np.ndarray:
    """Compares the contacts of arenas; returns their numbers."""
    random = np.random.default_rng(robots)
    place = np.zeros((arenas, robots, 3), np.float32)
    place[..., :2] = scene(random, arenas, robots)
    wide = float(np.median(np.abs(place[..., :2])))
    side = jnp.asarray(random.uniform(1.0, 5.0, arenas) * wide, jnp.float32)
    obstacle = jnp.asarray(_boxes(random, arenas, obstacles, wide), jnp.float32)
    given = jnp.asarray(place), side, obstacle
    number, expected = map(np.asarray, _by_pairs(*given))
    shape = (2, ROOM, arenas)
    found, contact = gaps_warp.list_by_cells(shape, float(RADIUS), *given, NUMBERS)
    np.testing.assert_array_equal(found, number)
    assert number.max() < ROOM
    listed = np.arange(ROOM)[:, None] < number
    np.testing.assert_array_equal(np.asarray(contact)[:, listed], expected[:, listed])
    return number


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(("robots", "obstacles"), [(9, 0), (20, 3), (150, 12)])
def test_cells_list_the_contacts_of_all_pairs(scene: Scene, robots: int, obstacles: int) -> None:
    assert _check(scene, 30, robots, obstacles).sum() > 0


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_cells_list_the_contacts_of_all_pairs_in_thousands_of_arenas(scene: Scene) -> None:
    for robots, obstacles, arenas in [(12, 4, 20_000), (70, 6, 4_000), (200, 40, 1_000)]:
        _check(scene, arenas, robots, obstacles)


def _accelerations(push_apart: Any, width: float) -> np.ndarray:
    """Returns accelerations [A, R, 3] of 100 robots in squares of this width, m."""
    random = np.random.default_rng(5)
    place = random.uniform(-0.5, 0.5, (3, 100, 3)) * [width, width, 6.0]
    rate, free, before = random.normal(size=(3, 3, 100, 3))
    numbers = random.uniform(5.0, 9.0, (3, 3, 100))
    given = map(jnp.float32, (place, rate, free, before, *numbers))
    index, friction = np.zeros((1, 100), int), np.float32(0.5)
    spring = np.array([0.02, 1.0]), np.array([0.9, 0.95, 0.001, 0.5, 2.0])
    discs = Discs(float(RADIUS), 0.016, 60, index[0], index, *spring, friction, push_apart)
    box = jnp.array([[0.05, 0.02, 0.4, 0.05, 0.05]], jnp.float32)
    solve = jax.vmap(lambda *robots: push_apart(discs, DiscRobots(*robots), jnp.float32(0.9), box))
    return np.asarray(solve(*given))


@pytest.mark.parametrize("push_apart", [planar_warp.push_apart, rubbing_warp.push_apart])
def test_solvers_return_the_same_bits_with_cells(
    push_apart: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contacts_warp, "MANY", 99)
    with_cells = _accelerations(push_apart, 0.9)
    monkeypatch.setattr(contacts_warp, "MANY", 100)
    np.testing.assert_array_equal(with_cells, _accelerations(push_apart, 0.9))
    assert np.isfinite(with_cells).all()


def test_an_arena_without_room_for_its_contacts_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contacts_warp, "MANY", 99)
    assert np.isnan(_accelerations(planar_warp.push_apart, 0.1)).all()
