"""Compares what surrounds robots, found by the Warp kernel, with plain JAX."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax import epuck
from swarmjax.sim import dispatch, engine, senses
from swarmjax.sim.fast import senses_warp
from swarmjax.sim.infrared import Reflectance
from swarmjax.sim.senses import Scene, Surround
from tests.sim.test_neighbours import RADIUS, RANGE, _scene

ARENAS = 3
# m; places up to 1 m round to 6e-8 m, and a ray that grazes a hull magnifies this a hundred times
ROUNDING = 1e-5


@pytest.fixture(autouse=True)
def _quiet() -> None:
    engine.start_warp()


def _look(robots: int, impl: str, *, drawn: bool, jammed: bool, arenas: int = ARENAS) -> Surround:
    """Looks around in random scenes, with drawn sensors and reflectances or without."""
    scenes = zip(*(_scene(seed, robots, jammed=jammed) for seed in range(arenas)), strict=True)
    scene = Scene(*(jnp.asarray(np.stack(part)) for part in scenes))
    if drawn:
        draw, boxes = np.random.default_rng(1), scene.obstacle.shape[1]
        shades = (jnp.float32(draw.uniform(0.2, 1.0, (arenas, n))) for n in (1 + boxes, robots))
        turn = jnp.float32(draw.normal(scale=0.1, size=(arenas, robots, 8)))
        scene = scene._replace(turn=turn, shades=Reflectance(*shades))
    look = jax.vmap(lambda each: senses.look(each, epuck.SENSOR_POSES, RADIUS, RANGE, impl))
    return jax.jit(look)(scene)


@pytest.mark.parametrize("jammed", [False, True])
@pytest.mark.parametrize("drawn", [False, True])
@pytest.mark.parametrize("robots", [1, 5, 30, 150])
def test_warp_finds_what_plain_jax_finds(robots: int, drawn: bool, jammed: bool) -> None:
    found, expected = (_look(robots, impl, drawn=drawn, jammed=jammed) for impl in ("warp", "jax"))
    assert expected.complete.all()
    np.testing.assert_allclose(found.ray, expected.ray, rtol=0, atol=ROUNDING)
    gap, near = np.asarray(found.gap), np.asarray(expected.gap) <= RANGE
    np.testing.assert_allclose(gap[near], np.asarray(expected.gap)[near], rtol=0, atol=ROUNDING)
    assert (gap[~near] > RANGE).all()
    assert (expected.ray < RANGE).any()
    if drawn:
        bright, brightness = np.asarray(found.bright), np.asarray(expected.bright)
        np.testing.assert_allclose(bright, brightness, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("jammed", [False, True])
@pytest.mark.parametrize("arenas", [ARENAS, pytest.param(10_000, marks=pytest.mark.slow)])
def test_cells_change_no_bit(arenas: int, jammed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def everything() -> list[Any]:
        return jax.tree.leaves(_look(30, "warp", drawn=True, jammed=jammed, arenas=arenas))

    expected = everything()
    monkeypatch.setattr(dispatch, "MOST_COMPARED", 29)
    for one, other in zip(everything(), expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_threads_of_a_robot_share_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    many = _look(5, "warp", drawn=True, jammed=True)
    monkeypatch.setattr(senses_warp, "_THREADS", 4 * ARENAS * 5)
    few = _look(5, "warp", drawn=True, jammed=True)
    for one, other in zip(jax.tree.leaves(many), jax.tree.leaves(few), strict=True):
        np.testing.assert_array_equal(one, other)
