"""Tests the choice of implementation and solver, and minima over the pieces of an axis."""

from functools import partial
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.config import ConfigError
from swarmjax.sim import dispatch
from swarmjax.sim.dispatch import MOST_PIECES, least, pieces

MODULES = pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])


def test_warp_is_asked_for_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"sim\.impl is warp"):
        dispatch.resolve_impl("warp")
    assert dispatch.resolve_impl("auto") == "jax"


def test_auto_is_jax_without_an_nvidia_gpu() -> None:
    assert dispatch.resolve_impl("auto") == "jax"
    assert dispatch.resolve_impl("jax") == "jax"
    assert dispatch.resolve_impl("warp") == "warp"


def test_the_solver_is_chosen() -> None:
    resolve = dispatch.resolve_solver
    assert resolve("auto", "warp", "planar", 50) == "swarm"
    assert resolve("auto", "warp", "wheeled", 64) == "swarm"
    assert resolve("auto", "warp", "wheeled", 65) == "mjx"
    assert resolve("auto", "jax", "planar", 50) == "swarm"
    assert resolve("auto", "jax", "wheeled", 5) == "mjx"
    assert resolve("mjx", "warp", "planar", 5) == "mjx"
    for impl, robots in (("jax", 5), ("warp", 65)):
        with pytest.raises(
            ConfigError, match=r"robot\.body is wheeled: give sim\.solver=mjx or auto, or"
        ):
            resolve("swarm", impl, "wheeled", robots)


def test_hulls_that_rub_are_solved_where_the_solver_knows_friction() -> None:
    resolve = partial(dispatch.resolve_solver, rubs=True)
    assert resolve("auto", "warp", "planar", 5) == resolve("auto", "jax", "planar", 5) == "swarm"
    assert resolve("auto", "warp", "wheeled", 5) == "mjx"
    with pytest.raises(ConfigError, match=r"at most 64 robots and without robot\.hull_friction"):
        resolve("swarm", "warp", "wheeled", 5)


@MODULES
@pytest.mark.parametrize("count", [3, MOST_PIECES + 1])
def test_least_of_all_pieces(xp: ModuleType, count: int) -> None:
    reach = np.stack([np.arange(count), 7.0 - np.arange(count), np.full(count, 9.0)])
    found = least([xp.asarray(reach)[:, i] for i in pieces(count, xp)], 6.5, xp)
    assert found.tolist() == [0.0, 7.0 - (count - 1), 6.5]


@MODULES
def test_of_no_things_none_is_near(xp: ModuleType) -> None:
    found = least([xp.zeros((2, 0))[:, i] for i in pieces(0, xp)], 6.5, xp)
    assert found.tolist() == [6.5, 6.5]
