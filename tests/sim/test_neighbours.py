"""Compares the robots found in cells with all pairs, and what infrared and gaps make of them."""

import functools
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.sim import dispatch, gaps, infrared, neighbours
from swarmjax.task.level import PARKING, PARKING_SPACING

RADIUS, RANGE = 0.037, 0.04  # m
REACH = 2.0 * RADIUS + RANGE  # m; centres of robots that are near each other
ROOM = neighbours.room(RADIUS, RANGE)
MODULES = pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
ROUNDING = 1e-7  # m; XLA rounds products and sums at once, or one by one

find = functools.partial(neighbours.find, hull_radius=RADIUS, limit=RANGE)


def _scene(seed: int, robots: int, *, jammed: bool) -> tuple[Any, Any, Any]:
    """Draws poses [R, 3] on a hexagonal lattice, a side that leaves some outside, and boxes."""
    draw = np.random.default_rng(seed)
    # Jammed hulls sink into each other by 5 % of their diameter.
    pitch = 0.95 * 2.0 * RADIUS if jammed else draw.uniform(2.1, 3.5) * RADIUS
    row, column = np.divmod(np.arange(2 * robots), int(np.sqrt(2 * robots)))
    lattice = np.stack([column + 0.5 * (row % 2), np.sqrt(0.75) * row], axis=-1) * pitch
    lattice -= lattice.mean(axis=0)
    turn = np.exp(1j * draw.uniform(0.0, 6.0))
    place = ((lattice[:, 0] + 1j * lattice[:, 1]) * turn)[draw.permutation(2 * robots)[:robots]]
    away = 0.0 if jammed else 0.02 * pitch
    pose = np.stack([place.real, place.imag, draw.uniform(-9.0, 9.0, robots)], axis=-1)
    pose[:, :2] += draw.uniform(-away, away, (robots, 2))
    half = 0.9 * np.abs(pose[:, :2]).max()
    box = np.concatenate(
        [draw.uniform([-half, -half, -9.0], half, (20, 3)), draw.uniform(0.01, 0.1, (20, 2))],
        axis=-1,
    )
    return pose.astype(np.float32), np.float32(2.0 * half), box.astype(np.float32)


def _pairs(pose: np.ndarray) -> np.ndarray:
    """Returns whether hulls [R, R] are within the infrared range of each other."""
    step = pose[:, None, :2].astype(float) - pose[None, :, :2]
    return np.hypot(step[..., 0], step[..., 1]) <= REACH


def _listed(near: neighbours.Near) -> np.ndarray:
    index = np.asarray(near.index)
    found = np.zeros((len(index),) * 2, bool)
    found[np.arange(len(index))[:, None], index] = True
    return found


@MODULES
@pytest.mark.parametrize("jammed", [False, True])
@pytest.mark.parametrize("robots", [1, 2, 30, 300])
def test_everyone_within_reach_is_listed(xp: ModuleType, robots: int, jammed: bool) -> None:
    pose, _, _ = _scene(robots, robots, jammed=jammed)
    near = find(xp.asarray(pose), xp=xp)
    assert near.index.shape == (robots, neighbours.ROWS * ROOM)
    assert not near.full
    assert _listed(near)[_pairs(pose)].all()


_COORDINATE = st.builds(
    lambda cell, ulps: np.nextafter(np.float32(cell), np.float32(np.sign(ulps) * 99)),
    st.integers(-40, 40).map(lambda cells: cells / 8 * neighbours._SLACK * REACH),
    st.integers(-1, 1),
)


@given(st.lists(st.tuples(_COORDINATE, _COORDINATE), min_size=1, max_size=40))
def test_robots_on_the_borders_of_cells_are_listed(places: list[tuple[float, float]]) -> None:
    pose = np.zeros((len(places), 3), np.float32)
    pose[:, :2] = places
    near = find(pose, xp=np)
    apart = np.hypot(*(pose[:, None, :2] - pose[:, :2]).T) + 9.0 * np.eye(len(pose))
    if apart.min() >= 0.85 * 2.0 * RADIUS:
        assert not near.full
    assert near.full or _listed(near)[_pairs(pose)].all()


@pytest.mark.parametrize("limit", [0.042, 0.045])  # whose reach float32 rounds down
@pytest.mark.parametrize("axis", [0, 1])
def test_two_robots_just_within_reach_are_listed_wherever_they_are(axis: int, limit: float) -> None:
    """Checks that rounding does not put the second robot two rows or 17 cells away."""
    reach = 2.0 * RADIUS + limit
    for cells in range(-200, 200):
        pose = np.zeros((2, 3), np.float32)
        pose[0, axis] = np.nextafter(np.float32(cells * reach), np.float32(-99))
        pose[1, axis] = pose[0, axis] + np.float32(reach)
        if float(pose[1, axis]) - float(pose[0, axis]) <= reach:
            assert _listed(neighbours.find(pose, RADIUS, limit, np)).all()


@MODULES
@pytest.mark.parametrize("more", [0, 1])
def test_more_robots_than_fit_are_noticed(xp: ModuleType, more: int) -> None:
    pose = np.zeros((ROOM + more, 3), np.float32)
    assert bool(find(xp.asarray(pose), xp=xp).full) == bool(more)


def test_parked_robots_fill_no_cell() -> None:
    pose = np.full((1024, 3), PARKING, np.float32)
    pose[:, 0] += PARKING_SPACING * np.arange(1024, dtype=np.float32)
    assert not find(pose, xp=np).full


def test_hulls_of_a_jam_fit_with_room_to_spare() -> None:
    """Counts the densest packing with 15 % of overlap in the cells of a row."""
    height = neighbours._SLACK * REACH
    pitch = 0.85 * 2.0 * RADIUS
    columns = np.floor(2.0625 * height / pitch) + 1
    rows = np.floor(height / (np.sqrt(0.75) * pitch)) + 1
    assert columns * rows <= ROOM
    assert ROOM == 14  # 8.0 by area, 5.6 by perimeter, and 1


def _check(scene: tuple[Any, Any, Any], xp: ModuleType) -> None:
    pose, side, box = map(xp.asarray, scene)
    draw = np.random.default_rng(len(pose))
    shades = infrared.Reflectance(
        xp.asarray(draw.uniform(0.1, 1.0, 1 + len(box)).astype(np.float32)),
        xp.asarray(draw.uniform(0.1, 1.0, len(pose)).astype(np.float32)),
    )
    look = functools.partial(infrared.distances, pose, side, box, RADIUS, RANGE, xp)
    see = functools.partial(infrared.sights, pose, side, box, RADIUS, RANGE, shades, infrared.EPUCK)
    near, tolerance = find(pose, xp=xp), 0.0 if xp is np else ROUNDING
    np.testing.assert_allclose(look(near=near), look(), rtol=0, atol=tolerance)
    for found, expected in zip(see(near=near), see(), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
    found, gap = (np.asarray(gaps.gaps(pose, side, box, RADIUS, xp, n)) for n in (near, None))
    seen = gap <= RANGE
    np.testing.assert_array_equal(found[seen], gap[seen])
    assert (found[~seen] > RANGE).all()


@MODULES
@pytest.mark.parametrize("jammed", [False, True])
@pytest.mark.parametrize("robots", [1, 70])
def test_rays_and_gaps_are_those_of_all_pairs(xp: ModuleType, robots: int, jammed: bool) -> None:
    _check(_scene(robots, robots, jammed=jammed), xp)


@MODULES
def test_the_brightest_of_two_boxes_that_hold_a_sensor_counts(xp: ModuleType) -> None:
    pose = xp.asarray(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], np.float32))
    box = xp.asarray(np.array([[0.05, 0.0, 0.0, 0.03, 0.05]] * 3, np.float32))
    shades = infrared.Reflectance(xp.asarray(np.array([1.0, 0.3, 0.7, 0.5], np.float32)))
    _, bright = infrared.sights(
        pose, np.float32(9.0), box, RADIUS, RANGE, shades, infrared.EPUCK, find(pose, xp=xp)
    )
    assert bright[0, [0, 7]].tolist() == pytest.approx([0.7, 0.7])


@pytest.mark.slow
@pytest.mark.parametrize("jammed", [False, True])
def test_rays_and_gaps_are_those_of_all_pairs_in_10000_arenas(jammed: bool) -> None:
    def compare(pose: Any, side: Any, box: Any) -> tuple[Any, ...]:
        near = find(pose, xp=jnp)
        return near.full, *(
            (
                infrared.distances(pose, side, box, RADIUS, RANGE, jnp, infrared.EPUCK, n),
                gaps.gaps(pose, side, box, RADIUS, jnp, n),
            )
            for n in (near, None)
        )

    scenes = [_scene(seed, 25, jammed=jammed) for seed in range(10_000)]
    full, (ray, gap), (every_ray, every_gap) = jax.jit(jax.vmap(compare))(
        *map(np.stack, zip(*scenes, strict=True))
    )
    assert not full.any()
    np.testing.assert_allclose(ray, every_ray, rtol=0, atol=ROUNDING)
    assert (every_ray < RANGE).mean() > 0.1
    seen = np.asarray(every_gap) <= RANGE
    np.testing.assert_allclose(np.asarray(gap)[seen], every_gap[seen], rtol=0, atol=ROUNDING)
    assert (np.asarray(gap)[~seen] > RANGE - ROUNDING).all()


@pytest.mark.parametrize(("robots", "listed"), [(100, 42), (130, 130)])
def test_few_robots_compare_all_pairs(robots: int, listed: int) -> None:
    assert not dispatch.has_cells(robots, listed)
    assert dispatch.has_cells(robots + 1, listed)
