"""Tests placement on a lattice, in whole units of 1/4096 m, by values worked out by hand."""

import re
from functools import partial
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.task.placement import (
    LATTICE,
    UNITS,
    Gap,
    lattice,
    metres,
    place,
    score_things,
    score_walls,
    units,
)

MODULES = pytest.mark.parametrize("xp", [np, jnp])
FORBIDDEN = -(2**30)


@MODULES
def test_units_are_parts_of_4096_of_a_metre(xp: ModuleType) -> None:
    lengths = xp.asarray([0.0, 0.7, 0.0374, -0.1], dtype=xp.float32)
    assert units(lengths, xp).tolist() == [0, 2867, 153, -410]  # 2867.2, 153.19, -409.6
    back = metres(units(lengths, xp), xp)
    # The tolerance is half a unit.
    np.testing.assert_allclose(back, lengths, atol=0.5 / UNITS)


@MODULES
def test_lattice_covers_the_square(xp: ModuleType) -> None:
    side = xp.asarray(2400)  # 24 steps of 100 units
    points = np.asarray(lattice(xp.zeros(2, dtype=xp.float32), side, xp))
    steps = np.arange(-1200, 1200, 100)
    expected = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    np.testing.assert_array_equal(points, expected)
    # The shifts are a quarter and three quarters of the spacing.
    shifted = np.asarray(lattice(xp.asarray([0.25, 0.75], dtype=xp.float32), side, xp))
    np.testing.assert_array_equal(shifted, expected + np.array([25, 75]))


@given(st.floats(0.0, 1.0, exclude_max=True, width=32), st.integers(1600, 16000))
def test_lattice_stays_in_the_square_and_leaves_no_hole(shift: float, side: int) -> None:
    points = lattice(np.full(2, shift, np.float32), np.array(side, np.int32), np)
    assert points.shape == (LATTICE**2, 2)
    axis = np.unique(points[:, 0])
    assert axis[0] >= -(side // 2)
    assert axis[-1] < side - side // 2
    assert np.diff(axis).max() <= -(-side // LATTICE)
    # The rim that no point covers is narrower than a step.
    assert axis[0] + side // 2 < side / LATTICE


@MODULES
def test_walls(xp: ModuleType) -> None:
    # At a side of 1000 and a least distance of 100, |x| and |y| up to 400 are free.
    points = xp.asarray([[0, 0], [400, -400], [401, 0], [0, -450], [600, 0]])
    found = score_walls(points, xp.asarray(1000), xp.asarray(100), xp).tolist()
    assert found == [0, 0, FORBIDDEN - 1, FORBIDDEN - 50, FORBIDDEN - 200]


@MODULES
def test_things(xp: ModuleType) -> None:
    # Things are at (0, 0) and (1000, 0), and a third is absent. Gaps are 30 (hard) and 50 (soft).
    centres, there = xp.asarray([[0, 0], [1000, 0], [300, 0]]), xp.asarray([True, True, False])
    points = xp.asarray([[300, 0], [30, 40], [24, 32], [18, 24], [3, 4], [1000, 29]])
    found = score_things(points, centres, there, Gap(30, 50), xp).tolist()
    # Distances are 300; 50, which just keeps the soft gap; 40, which scores 1600 - 2500; 30, which
    # just keeps the hard gap; and 5 and 29, which break the hard gap.
    assert found == [0, 0, -900, -1600, FORBIDDEN + 25, FORBIDDEN + 841]


@MODULES
def test_nothing_to_keep_away_from(xp: ModuleType) -> None:
    points, nothing = xp.asarray([[1, 2], [3, 4]]), xp.zeros((0, 2), dtype=xp.int32)
    found = score_things(points, nothing, xp.zeros(0, dtype=bool), Gap(30, 50), xp)
    assert found.tolist() == [0, 0]


ROW = np.array([[0, 0], [10, 0], [20, 0], [30, 0], [40, 0]])


@MODULES
@pytest.mark.parametrize(
    ("picks", "there", "gap", "expected", "sound"),
    [
        # Free points are equally likely: 0.0 picks the first of five, and 0.99 the last.
        ([0.0, 0.99], [True, True], Gap(5, 5), [0, 40], [True, True]),
        # 0.5 picks the third of five points, at 20. Of the free 0, 10, 30 and 40, it picks 30.
        ([0.5, 0.5], [True, True], Gap(5, 5), [20, 30], [True, True]),
        # After 20, a soft gap of 20 leaves 0 and 40 free.
        ([0.5, 0.5], [True, True], Gap(5, 20), [20, 40], [True, True]),
        # After 20, no point keeps a soft gap of 30: the first of the farthest is taken.
        ([0.5, 0.5], [True, True], Gap(5, 30), [20, 0], [True, True]),
        # After 20, no point keeps a hard gap of 30: the same point is taken, but is not sound.
        ([0.5, 0.5], [True, True], Gap(30, 30), [20, 0], [True, False]),
        # An absent thing keeps nothing away.
        ([0.5, 0.5], [False, True], Gap(5, 20), [20, 20], [False, True]),
    ],
)
def test_place(
    xp: ModuleType,
    picks: list[float],
    there: list[bool],
    gap: Gap,
    expected: list[int],
    sound: list[bool],
) -> None:
    free = xp.zeros(5, dtype=xp.int32)
    uniform = xp.asarray(picks, dtype=xp.float32)
    centres, kept = place(xp.asarray(ROW), free, uniform, xp.asarray(there), gap, xp)
    assert centres.tolist() == [[x, 0] for x in expected]
    assert kept.tolist() == sound


@MODULES
def test_place_heeds_the_score_it_is_given(xp: ModuleType) -> None:
    score = xp.asarray([0, 0, FORBIDDEN - 5, -7, 0])
    picks = xp.asarray([0.99, 0.99, 0.99, 0.99], dtype=xp.float32)
    centres, sound = place(xp.asarray(ROW), score, picks, xp.ones(4, dtype=bool), Gap(1, 1), xp)
    # The three free points are taken from the last to the first, then the one with score -7.
    assert centres[:, 0].tolist() == [40, 10, 0, 30]
    assert sound.tolist() == [True] * 4


@MODULES
def test_place_nothing(xp: ModuleType) -> None:
    none = xp.zeros(0, dtype=xp.float32)
    free = xp.zeros(5, dtype=xp.int32)
    centres, sound = place(xp.asarray(ROW), free, none, none.astype(bool), Gap(1, 1), xp)
    assert centres.shape == (0, 2)
    assert sound.shape == (0,)


def _place_two(score: jax.Array | np.ndarray, picks: jax.Array) -> jax.Array:
    there = jnp.ones(2, dtype=bool)
    return place(jnp.asarray(ROW), score, picks, there, Gap(5, 5), jnp)[0]


def _reductions(lowered: jax.stages.Lowered) -> int:
    return len(re.findall(r" reduce(?:-window)?\(", lowered.compile().as_text() or ""))


def test_xla_does_not_search_free_points_as_it_compiles() -> None:
    # XLA used to search constant points at compile time, arena by arena, for minutes. It must leave
    # this search to the program, as it does for points that it cannot know.
    picks = jax.ShapeDtypeStruct((8, 2), jnp.float32)
    score = jax.ShapeDtypeStruct((8, len(ROW)), jnp.int32)
    free = np.zeros(len(ROW), np.int32)
    known = jax.jit(jax.vmap(partial(_place_two, free))).lower(picks)
    unknown = jax.jit(jax.vmap(_place_two)).lower(score, picks)
    assert _reductions(known) == _reductions(unknown) > 0
