"""The price on contacts between robots, by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.config import AlgoConfig
from swarmjax.ppo import contact_price
from swarmjax.ppo import learner as ppo
from swarmjax.training import rollout
from swarmjax.training.rollout import Trajectory

CONFIG = AlgoConfig(contact_limit=0.1, contact_price_rate=1e-3, contact_price_arrivals=0.9)


def _at(height: float, contacts: float, episodes: float, arrivals: float) -> contact_price.Price:
    return contact_price.Price(
        height=jnp.float32(height),
        contacts=jnp.float32(contacts),
        episodes=jnp.float32(episodes),
        arrivals=jnp.float32(arrivals),
    )


def _seen(contacts: float, episodes: float, arrivals: float) -> contact_price.Seen:
    return contact_price.Seen(*(jnp.float32(x) for x in (contacts, episodes, arrivals)))


@pytest.mark.parametrize(
    ("seen", "pace"),
    [
        ((4.0, 20.0, 20.0), 1.0),  # 0.2 an episode: twice the limit, as fast as it goes
        ((40.0, 20.0, 20.0), 1.0),  # and no faster
        ((3.0, 20.0, 20.0), 0.5),  # 0.15 an episode: half a limit too many
        ((2.0, 20.0, 20.0), 0.0),
        ((1.0, 20.0, 18.0), -0.5),
        ((0.0, 20.0, 20.0), -1.0),
        ((40.0, 20.0, 17.0), -1.0),  # less than 0.9 arrive
        ((5.0, 0.0, 0.0), 0.0),  # before anything has ended
    ],
)
def test_it_moves_by_what_is_too_many(seen: tuple[float, float, float], pace: float) -> None:
    # Remembered as they come now, so that the means stay what they are.
    after = contact_price.update(_at(0.5, *seen), CONFIG, _seen(*seen), 32)
    # 1e-6: float32, the height of 0.5 to 6e-8 and the pace to 1e-5 of 0.032.
    np.testing.assert_allclose(after.height, 0.5 + 32 * 1e-3 * pace, atol=1e-6)


def test_it_remembers_twenty_updates() -> None:
    before = _at(0.0, 2.0, 10.0, 9.0)
    after = contact_price.update(before, CONFIG, _seen(4.0, 0.0, 0.0), 32)
    # 1 / 20 of what is new: 2 + 0.05 (4 - 2), 10 + 0.05 (0 - 10), 9 + 0.05 (0 - 9).
    found = [after.contacts, after.episodes, after.arrivals]
    np.testing.assert_allclose(found, [2.1, 9.5, 8.55], rtol=1e-6)
    # 2.1 / 9.5 is 2.2 times the limit of 0.1: more than twice.
    np.testing.assert_allclose(after.height, 0.032, rtol=1e-6)
    # A learner whose robot is away keeps what it has.
    assert contact_price.update(before, CONFIG, _seen(0.0, 0.0, 0.0), 32) == before


@given(contacts=st.lists(st.integers(0, 50), min_size=1, max_size=30), height=st.floats(0.0, 0.1))
def test_it_is_never_below_nothing_and_no_faster_than_it_may(contacts, height):
    price = _at(height, 0.0, 0.0, 0.0)
    for each in contacts:
        before = float(price.height)
        price = contact_price.update(price, CONFIG, _seen(each, 3.0, 3.0), 32)
        assert price.height >= 0.0
        assert abs(float(price.height) - before) <= 0.032 * (1 + 1e-5)  # float32


def test_contacts_are_charged_to_whoever_had_them() -> None:
    config = replace(CONFIG, contact_price_rate=0.01)
    learners = jax.vmap(lambda key: ppo.init(key, config, 10, 2, 5))(
        jax.random.split(jax.random.key(0), 2)
    )
    assert learners.price is not None
    learners = replace(learners, price=replace(learners.price, height=jnp.array([0.5, 0.25])))
    # Two control steps of two learners, two arenas, a robot each.
    contact = np.array([[[[1], [0]], [[1], [1]]], [[[0], [1]], [[0], [0]]]], np.float32)
    valid = np.ones_like(contact, bool)
    valid[0, 1, 1] = False  # a robot that had arrived pays nothing
    ends = np.zeros_like(valid)
    ends[1, :, 0] = True
    zero = jnp.zeros(contact.shape)
    trajectory = Trajectory(
        observation=zero,
        action=zero,
        log_prob=zero,
        value=zero,
        next_value=zero,
        reward=jnp.ones(contact.shape),
        terminated=jnp.asarray(ends),
        truncated=jnp.zeros(contact.shape, bool),
        valid=jnp.asarray(valid),
        robot_contact=jnp.asarray(contact),
    )
    charged, found = rollout.charge(learners, trajectory, config)
    due = np.array([0.5, 0.25])[None, :, None, None] * np.where(valid, contact, 0.0)
    np.testing.assert_allclose(found.reward, 1.0 - due)
    assert charged.price is not None
    # Two contacts and one, in one episode each: far above 0.1, both rise by 2 steps of 0.01.
    np.testing.assert_allclose(charged.price.height, [0.52, 0.27], rtol=1e-6)
    np.testing.assert_allclose(charged.price.contacts, [0.1, 0.05], rtol=1e-6)
    free = replace(learners, price=None)  # without a limit
    assert rollout.charge(free, trajectory, AlgoConfig()) == (free, trajectory)
