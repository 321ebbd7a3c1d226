"""Checks that peers' robots sense what ours sense."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import peer_environments
from benchmarks.peer_environments import JaxNavConfig


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")  # of JaxMARL
@pytest.mark.parametrize(("gap", "is_seen"), [(0.03, True), (0.05, False)])
def test_jaxnav_sees_4_cm_beyond_the_hull(gap: float, is_seen: bool) -> None:
    pytest.importorskip("jaxmarl", reason="needs the extra jaxmarl")
    world = peer_environments.make_jaxnav(JaxNavConfig(arenas=(1,), robots=2))
    _, state = world.reset(jax.random.key(0))
    away = (2 * 0.037 + gap) * 0.3 / 0.037  # between centres, in JaxNav's lengths
    angle = np.pi / 8  # of a beam
    place = np.array([[6.0, 6.0], [6.0 + away * np.cos(angle), 6.0 + away * np.sin(angle)]])
    empty = jnp.zeros_like(state.map_data)
    near = replace(state, pos=jnp.array(place), theta=jnp.zeros(2), map_data=empty)
    beams = np.array(world.get_obs(near)["agent_0"][: peer_environments.BEAMS])
    assert (beams < beams.max()).any() == is_seen
