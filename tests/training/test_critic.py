"""Checks a critic that sees the state: its input, what it learns, and that actors never see it."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest
from flax import linen as nn

from swarmjax import policy, policy_file
from swarmjax.config import ConfigError
from swarmjax.extension import Network
from swarmjax.ppo import dispatch, gradients, networks
from swarmjax.ppo.batch import Batch, Trajectory
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Normalizer, Sizes
from swarmjax.ppo.ppo import PPO, LearnerState
from swarmjax.run.checkpoint import to_leaves
from swarmjax.run.policy_export import write_policy
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import physics
from swarmjax.task import env, observation
from swarmjax.task.env import EnvState
from swarmjax.training import loop, mesh, rollout, seeds
from swarmjax.training import program as programs
from swarmjax.training.rollout import Arena, Program


class Trained(NamedTuple):
    """A run after three updates, and its next rollout, in which episodes end."""

    program: Program
    learners: LearnerState
    before: Arena
    waiting: Arena
    trajectory: Trajectory
    over: np.ndarray  # [T, A] whether the episode ended with the step


def _algo(config: TrainConfig, **rest: Any) -> AlgoConfig:
    return AlgoConfig(**{**vars(config.algo), "critic": "state", **rest})


@pytest.fixture(scope="module")
def trained(tiny_config: TrainConfig) -> Trained:
    """Returns a rollout of one learner for each robot, each with a memory and random weights."""
    algo = _algo(tiny_config, policy="independent", memory="gru", memory_size=4)
    config = replace(tiny_config, algo=algo)
    program, schedule = programs.load(config)
    last = jax.jit(partial(loop.init, program))(schedule)
    last = replace(last, learners=learners.moved(last.learners))
    draw = jax.jit(partial(loop._draw, program, schedule, waiting=1))
    waiting = draw(last.curriculum, jax.random.key(1))
    # The arenas are in the middle of their episodes, which end at 16 steps.
    before = replace(last.arenas, clock=jnp.array([0, 0, 9, 10, 11, 12, 13, 0], jnp.int32))
    collect = jax.jit(partial(rollout.collect, program))
    _, trajectory, ended = collect(last.learners, before, waiting, jax.random.key(2))
    over = np.asarray(ended.episodes) > 0
    return Trained(program, last.learners, before, waiting, trajectory, over)


def _look(trained: Trained, arenas: EnvState) -> np.ndarray:
    """Returns the surroundings of each robot in the layout of the learners, [L, A, N, P]."""
    around = jax.jit(jax.vmap(partial(env.look_around, trained.program.world)))(arenas)
    return np.asarray(rollout.to_learners(around, trained.program.config.learners))


def _value(trained: Trained, arenas: Arena, memory: jax.Array) -> np.ndarray:
    """Returns the critics' values of the arenas, computed by hand, [L, A, N].

    `memory` is [A, R, H].
    """
    seen, mine = (
        rollout.to_learners(x, trained.program.config.learners)
        for x in (arenas.observation, memory)
    )
    normal = jax.vmap(Normalizer.normalize)(trained.learners.normalizer, seen)
    nets = trained.program.ppo.learning.networks
    value, _ = jax.vmap(nets.value)(trained.learners.params, normal, _look(trained, arenas), mine)
    return np.asarray(value)


def _stepped(trained: Trained) -> Arena:
    """Returns the arenas after the first step of the rollout, before any reset."""
    world = trained.program.world
    unpack = jax.vmap(partial(physics.unpack, world.physics))
    arenas = replace(trained.before, sim=unpack(trained.before.sim))
    action = rollout.to_arenas(trained.trajectory.action[0])
    return jax.jit(jax.vmap(partial(env.step, world)))(arenas, action)[0]


def test_the_critic_is_shown_what_is_around_each_robot(trained: Trained) -> None:
    seen = trained.trajectory.state
    assert seen is not None
    assert seen.shape[-1] == trained.program.ppo.sizes.state
    # Two compiled programs round float32 distances of at most 2 m differently.
    np.testing.assert_allclose(seen[0], _look(trained, trained.before), rtol=0, atol=1e-6)
    # float32 rounding: a single step and the scan are different compiled programs.
    np.testing.assert_allclose(seen[1], _look(trained, _stepped(trained)), atol=1e-5)


def test_where_an_episode_ends_it_is_shown_the_next_one(trained: Trained) -> None:
    seen, over = trained.trajectory.state, trained.over
    assert seen is not None
    first = _look(trained, trained.waiting)
    steps, arenas = np.nonzero(over[:-1])
    assert len(steps) > 2
    for step, arena in zip(steps, arenas, strict=True):
        # Two compiled programs round differently.
        found = seen[step + 1, :, arena]
        np.testing.assert_allclose(found, first[:, arena], rtol=0, atol=1e-6)


def test_its_value_is_that_of_observation_and_state(trained: Trained) -> None:
    recall = trained.before.recall
    assert recall is not None
    value = _value(trained, trained.before, recall.critic)
    # float32 rounding of a matrix product that is batched in another way.
    np.testing.assert_allclose(trained.trajectory.value[0], value, atol=1e-5)


def test_the_next_value_is_of_what_the_step_reached(trained: Trained) -> None:
    found, over = trained.trajectory, trained.over
    # [T - 1, L, A, N], as the values
    going = np.broadcast_to(~over[:-1, None, :, None], found.value[1:].shape)
    assert not going.all()
    np.testing.assert_array_equal(
        np.asarray(found.next_value)[:-1][going], np.asarray(found.value)[1:][going]
    )
    # Where an episode ended, the next value is of its last state, not of the next episode's start.
    ends = np.asarray(found.next_value)[:-1][~going], np.asarray(found.value)[1:][~going]
    assert np.abs(ends[0] - ends[1]).min() > 1e-6


def test_the_actor_sees_nothing_of_it(trained: Trained) -> None:
    """The actor's first layer takes only the observation; the critic's takes the state as well."""
    params: Any = trained.learners.params
    size, more = trained.program.world.observation_size, trained.program.ppo.sizes.state
    layer = {side: params[side]["torso"]["hidden_0"]["kernel"] for side in params}
    assert layer["actor"].shape[1] == size
    assert layer["critic"].shape[1] == size + more


@pytest.mark.slow
def test_seeds_side_by_side_are_those_alone(tiny_config: TrainConfig) -> None:
    """Trains for one update with a memory, a critic of the state, and a policy for each robot."""
    algo = _algo(tiny_config, policy="independent", memory="gru", memory_size=4)

    def run(first: int, count: int) -> dict[str, np.ndarray]:
        config = replace(tiny_config, algo=algo, seed=first, seeds=count, seeds_by="vmap")
        program, schedule = programs.load(config)
        state = jax.jit(mesh.init(program))(schedule)
        state, _ = jax.jit(seeds.chunk(program))(schedule, state, np.int32(1))
        return to_leaves(state.learners.params)

    together = run(0, 2)
    for lane in range(2):
        for name, leaf in run(lane, 1).items():
            # Batched matrix products round differently, as in test_seeds.py.
            np.testing.assert_allclose(together[name][lane], leaf[0], atol=1e-5, err_msg=name)


# --- what is learned

SIZE, STATE = 3, 5
CONFIG = AlgoConfig(
    critic="state",
    hidden_sizes=(16,),
    num_minibatches=2,
    epochs=4,
    critic_learning_rate=1e-2,
    learning_rate_schedule="constant",
)


def _ppo(config: AlgoConfig = CONFIG, backend: dispatch.Backend = "autodiff") -> PPO:
    return learners.ppo(config, Sizes(SIZE, 2, STATE), 100, backend)


def _batch(learner: LearnerState, seed: int) -> Batch:
    """Returns samples whose return depends on the state alone."""
    keys = jax.random.split(jax.random.key(seed), 3)
    shape = (8, 32)
    observation = jax.random.normal(keys[0], (*shape, SIZE))
    noise = jax.random.normal(keys[1], (*shape, 2))
    state = jax.random.normal(keys[2], (*shape, STATE))
    action, log_prob, _ = jax.jit(_ppo().act)(learner, observation, noise)
    return Batch(
        observation=observation,
        action=action,
        log_prob=log_prob,
        advantage=jnp.zeros(shape),
        return_=jnp.tanh(state[..., 0] - state[..., 1]),
        valid=jnp.ones(shape, bool),
        state=state,
    )


def _learn(told: bool) -> float:
    """Trains a critic with the state, or with zeros in its place; returns the last value loss."""
    learner, update = jax.jit(_ppo().init)(jax.random.key(0)), jax.jit(_ppo().update)
    loss = np.inf
    for step in range(100):
        batch = _batch(learner, step)
        shown = batch if told else replace(batch, state=jnp.zeros((8, 32, STATE)))
        learner, metrics = update(learner, shown, jax.random.key(step))
        loss = float(metrics["value_loss"])
    return loss


@pytest.mark.slow
def test_a_value_that_only_the_state_tells_is_learned() -> None:
    # Half the variance of the returns is 0.19: the least loss without the state.
    assert _learn(told=True) < 0.02
    assert _learn(told=False) > 0.15


@pytest.mark.parametrize("backend", ["autodiff", pytest.param("blocks", marks=pytest.mark.slow)])
def test_a_state_changes_nothing_of_the_policy_but_by_its_guess(
    backend: dispatch.Backend, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gradients, "GUESS_COST", 0.0)
    # No clipping here: it scales both networks by one norm, so the critic would change the actor.
    config = replace(CONFIG, num_minibatches=1, max_grad_norm=None)
    made = _ppo(config, backend)
    learner = jax.jit(made.init)(jax.random.key(0))
    batch = replace(_batch(learner, 0), advantage=_batch(learner, 1).return_)
    other = replace(batch, state=jnp.zeros((8, 32, STATE)))
    update = jax.jit(made.update)
    one, two = (update(learner, each, jax.random.key(0))[0].params for each in (batch, other))
    jax.tree.map(np.testing.assert_array_equal, one["actor"], two["actor"])
    kernels = [each["critic"]["torso"]["hidden_0"]["kernel"] for each in (one, two)]
    assert np.abs(kernels[0] - kernels[1]).max() > 0.0


def test_a_state_that_is_not_finite_is_left_out() -> None:
    learner = jax.jit(_ppo().init)(jax.random.key(0))
    batch = _batch(learner, 0)
    assert batch.state is not None
    spoilt = replace(batch, state=batch.state.at[0, 0, 0].set(jnp.nan))
    without = replace(batch, valid=batch.valid.at[0, 0].set(False))
    found, expected = (
        jax.jit(_ppo().update)(learner, each, jax.random.key(0))[0] for each in (spoilt, without)
    )
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_what_is_not_valid_may_hold_nan() -> None:
    learner = jax.jit(_ppo().init)(jax.random.key(0))
    batch = _batch(learner, 0)
    assert batch.state is not None
    valid = batch.valid.at[:, ::2].set(False)
    holes = jnp.where(valid[..., None], batch.state, jnp.nan)
    found, expected = (
        jax.jit(_ppo().update)(learner, replace(batch, valid=valid, state=x), jax.random.key(0))[0]
        for x in (holes, batch.state)
    )
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.slow
def test_the_policy_file_acts_as_the_learner_and_holds_no_guess(
    tiny_config: TrainConfig, tmp_path: Path
) -> None:
    config = replace(tiny_config, algo=_algo(tiny_config))
    program, schedule = programs.load(config)
    state = jax.jit(partial(loop.init, program))(schedule)
    assert "guess" in state.learners.params["actor"]
    leaves = {name: leaf[None] for name, leaf in to_leaves(state).items()}
    write_policy(tmp_path / "policy.npz", leaves, config, update=0, seed=0)
    seen = np.random.default_rng(0).normal(size=(50, observation.SIZE)).astype(np.float32)
    learner = jax.tree.map(lambda leaf: leaf[0], state.learners)
    found = policy.act(policy_file.read(tmp_path / "policy.npz"), seen[:, None])[:, 0]
    # float32, sums of ten terms
    mode, _, _ = program.ppo.act(learner, seen, np.zeros_like(found))
    np.testing.assert_allclose(found, mode, atol=2e-6)


# --- settings that do not go with a critic of the state


def test_a_network_that_takes_the_observation_alone_is_refused() -> None:
    class Fixed(nn.Module):
        @nn.compact
        def __call__(self, observation: jax.Array) -> jax.Array:
            return observation.reshape(-1, SIZE)

    own = [Network(name="fixed", function=Fixed)]
    config = replace(CONFIG, network="fixed")
    assert networks.make(config, Sizes(SIZE, 2), own).actor.torso is Fixed
    with pytest.raises(ConfigError, match="network fixed returns"):
        networks.make(config, Sizes(SIZE, 2, STATE), own)
