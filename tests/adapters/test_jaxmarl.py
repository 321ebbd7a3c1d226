"""Tests the contract of JaxMARL's environments, for which JaxMARL has no checker."""

import contextlib
import io
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from courses import ARENA_SEED, LIMIT, Course, assert_close, drawn_key

from swarmjax.environment import Swarm

# On import, JaxMARL prints which of its environments are missing. It also imports JAXopt, which
# warns that it is unmaintained.
with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv
    from jaxmarl.wrappers.baselines import LogWrapper

    from swarmjax.adapters.jaxmarl import SwarmMultiAgentEnv

AGENTS = ["agent_0", "agent_1"]
ARRIVED = 42  # index of the step in which agent_0 arrives, see courses.py


@pytest.fixture(scope="module")
def env(arena: Swarm) -> SwarmMultiAgentEnv:
    return SwarmMultiAgentEnv(arena)


@pytest.fixture(scope="module")
def steps(env: SwarmMultiAgentEnv, arena_course: Course) -> list[tuple]:
    """Returns the steps of two vmapped arenas with one seed, as `env.step` returns them."""
    keys = jnp.stack([drawn_key(ARENA_SEED)] * 2)
    _, state = jax.vmap(env.reset)(keys)
    step, found = jax.jit(jax.vmap(env.step)), []
    for told in arena_course.action[: LIMIT + 1]:
        actions = {agent: jnp.stack([told[0, i]] * 2) for i, agent in enumerate(AGENTS)}
        found.append(step(keys, state, actions))
        state = found[-1][1]
    return found


@pytest.mark.slow
def test_observations_and_rewards_are_those_of_the_course(
    steps: list, arena_course: Course
) -> None:
    for t, (seen, _, reward, *_) in enumerate(steps):
        for i, agent in enumerate(AGENTS):
            assert (seen[agent].shape, reward[agent].shape) == ((2, 10), (2,))
            for arena in range(2):
                assert_close(seen[agent][arena], arena_course.after[t, 0, i])
                assert_close(reward[agent][arena], arena_course.came.reward[t, 0, i])


@pytest.mark.slow
def test_who_arrives_is_done_until_all_are(steps: list) -> None:
    dones = {name: [bool(step[3][name][0]) for step in steps] for name in [*AGENTS, "__all__"]}
    early, late = [False] * ARRIVED, [False] * (LIMIT - 1)
    assert dones["agent_0"] == [*early, *[True] * (LIMIT - ARRIVED), False]
    assert dones["agent_1"] == dones["__all__"] == [*late, True, False]


@pytest.mark.slow
def test_infos_are_arrays_over_agents(steps: list, arena_course: Course) -> None:
    for t, (*_, info) in enumerate(steps):
        assert sorted(info) == ["is_success", "terminated", "truncated", "valid"]
        # agent_0 has arrived before the episode ends, and agent_1 never does.
        success = np.array([t == LIMIT - 1, False])
        for name, found in info.items():
            expected = getattr(arena_course.came, name)[t, 0] if name != "is_success" else success
            np.testing.assert_array_equal(found, [expected, expected])


@pytest.mark.slow
def test_who_has_arrived_has_no_actions(env: SwarmMultiAgentEnv, steps: list) -> None:
    free = jax.vmap(env.get_avail_actions)
    before, after = free(steps[ARRIVED - 1][1]), free(steps[ARRIVED][1])
    assert all(np.all(before[agent]) for agent in AGENTS)
    assert not np.any(after["agent_0"])
    assert np.all(after["agent_1"])
    assert after["agent_1"].shape == (2, 2)


@pytest.mark.slow
def test_step_env_stays_in_the_episode(
    env: SwarmMultiAgentEnv, steps: list, arena_course: Course
) -> None:
    before = jax.tree.map(lambda x: x[0], steps[LIMIT - 2][1])
    told = arena_course.action[LIMIT - 1, 0]
    seen, after, *_ = jax.jit(env.step_env)(
        jax.random.key(0), before, dict(zip(AGENTS, told, strict=True))
    )
    last = arena_course.came.observation[LIMIT - 1, 0]
    assert_close(seen["agent_1"], last[1])
    assert_close(after.observation[0, 1], last[1])
    assert int(after.arenas.clock[0]) == LIMIT


@pytest.mark.slow
def test_an_episode_starts_from_what_is_given(env: SwarmMultiAgentEnv, steps: list) -> None:
    again = env.reset(jax.random.key(5))
    actions = dict.fromkeys(AGENTS, jnp.zeros(2))
    for t, expected in ((LIMIT - 2, True), (LIMIT - 4, False)):
        before = jax.tree.map(lambda x: x[0], steps[t][1])
        seen, *_ = env.step(jax.random.key(0), before, actions, again[1])
        assert np.array_equal(seen["agent_0"], again[0]["agent_0"]) == expected


def test_spaces_and_classes(env: SwarmMultiAgentEnv) -> None:
    assert isinstance(env, MultiAgentEnv)
    assert env.agents == AGENTS
    assert env.agent_classes == {"robot": AGENTS}
    assert env.observation_space("agent_0").shape == (10,)
    action = env.action_space("agent_1").sample(jax.random.key(0))
    assert action.shape == (2,)
    assert env.action_space("agent_1").contains(action)
    assert not env.action_space("agent_1").contains(action + 2.0)


@pytest.mark.slow
def test_jaxmarls_wrapper_takes_it(env: SwarmMultiAgentEnv) -> None:
    wrapped = LogWrapper(env)
    _, state = wrapped.reset(jax.random.key(0))
    *_, info = wrapped.step(jax.random.key(1), state, dict.fromkeys(AGENTS, jnp.zeros(2)))
    assert {leaf.shape for leaf in jax.tree.leaves(info)} == {(2,)}


@pytest.mark.parametrize(
    ("actions", "sentence"),
    [
        ({"agent_0": jnp.zeros(2)}, r"^actions lack \['agent_1'\]: give"),
        (dict.fromkeys(AGENTS, jnp.zeros(3)), r"^agent_0: action has the shape \(3,\)"),
        (dict.fromkeys(AGENTS, jnp.zeros(2, int)), "^agent_0: action is of dtype int32"),
    ],
)
def test_wrong_actions_are_refused(env: SwarmMultiAgentEnv, actions: dict, sentence: str) -> None:
    _, state = env.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=sentence):
        env.step(jax.random.key(0), state, actions)
