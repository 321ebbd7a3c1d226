"""PPO and networks for tests, of settings and sizes alone."""

from dataclasses import replace
from functools import cache, partial

import jax
import numpy as np
import pytest
from jax.experimental import pallas

from swarmjax.ppo import networks
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.dispatch import Backend
from swarmjax.ppo.networks import Networks, Sizes
from swarmjax.ppo.ppo import PPO, LearnerState


@cache
def ppo(config: AlgoConfig, sizes: Sizes, updates: int = 10, backend: Backend | None = None) -> PPO:
    """Returns PPO; without a backend, what the config chooses."""
    made = PPO.make(config, sizes, updates)
    return made if backend is None else replace(made, backend=backend)


@cache
def nets(config: AlgoConfig, observation: int, action: int, state: int = 0) -> Networks:
    """Returns actor and critic."""
    return networks.make(config, Sizes(observation, action, state))


def interpret_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs Pallas kernels as ordinary JAX, on any device."""
    monkeypatch.setattr(pallas, "pallas_call", partial(pallas.pallas_call, interpret=True))


def moved(state: LearnerState) -> LearnerState:
    """Returns learners with random weights that tell them apart: critics begin near zero."""
    draw = np.random.default_rng(0)
    params = jax.tree.map(
        lambda x: x + 0.2 * draw.standard_normal(x.shape, np.float32), state.params
    )
    return replace(state, params=params)
