"""Checks what one update must and must not do."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import learners
import numpy as np
import optax
import pytest

from swarmjax.ppo import gradients, networks, optimizer
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO, LearnerState

G, N, OBSERVATION, U, UPDATES = 8, 6, 3, 2, 5
CONFIG = AlgoConfig(hidden_sizes=(8,), epochs=3, num_minibatches=4, entropy_cost=0.01)
ONE_STEP = AlgoConfig(hidden_sizes=(8,), epochs=1, num_minibatches=1)


def _ppo(config: AlgoConfig = CONFIG) -> PPO:
    return learners.ppo(config, Sizes(OBSERVATION, U), UPDATES)


@functools.partial(jax.jit, static_argnames="config")
def _update(
    state: LearnerState, batch: Batch, key: jax.Array, config: AlgoConfig = CONFIG
) -> tuple[LearnerState, gradients.Metrics]:
    return _ppo(config).update(state, batch, key)


def _batch(state: LearnerState, seed: int = 0, config: AlgoConfig = CONFIG) -> Batch:
    observation_key, noise_key, target_key, valid_key = jax.random.split(jax.random.key(seed), 4)
    observation = 3.0 + 2.0 * jax.random.normal(observation_key, (G, N, OBSERVATION))
    noise = jax.random.normal(noise_key, (G, N, U))
    action, log_prob, _ = _ppo(config).act(state, observation, noise)
    advantage, return_ = 5.0 + 2.0 * jax.random.normal(target_key, (2, G, N))
    return Batch(
        observation=observation,
        action=action,
        log_prob=log_prob,
        advantage=advantage,
        return_=return_,
        valid=jax.random.bernoulli(valid_key, 0.7, (G, N)),
    )


def _fresh(seed: int = 0, config: AlgoConfig = CONFIG) -> LearnerState:
    return jax.jit(_ppo(config).init)(jax.random.key(seed))


def _experienced(seed: int = 0, config: AlgoConfig = CONFIG) -> LearnerState:
    """Returns a learner after one update, so with Adam's momentum and observation moments.

    Its mean actions depend strongly on the observation.
    """
    state = _fresh(seed, config)
    state, _ = _update(state, _batch(state, 10, config), jax.random.key(20), config=config)
    params = jax.tree.map(jnp.copy, state.params)
    params["actor"]["mean"]["kernel"] *= 100.0
    return replace(state, params=params)


def _spoilt(batch: Batch, valid: jax.Array) -> Batch:
    """Returns the batch with NaN in all invalid samples."""

    def spoil(x: jax.Array) -> jax.Array:
        return jnp.where(valid.reshape(valid.shape + (1,) * (x.ndim - 2)), x, jnp.nan)

    return replace(jax.tree.map(spoil, batch), valid=valid)


def _assert_equal(got: object, expected: object) -> None:
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def _step_sizes(before: networks.Params, after: networks.Params) -> dict[str, float]:
    """Returns the largest change of any parameter, by network."""
    return {
        name: max(
            float(jnp.abs(a - b).max())
            for a, b in zip(
                jax.tree.leaves(after[name]), jax.tree.leaves(before[name]), strict=True
            )
        )
        for name in before
    }


def test_act_mode_and_values_normalise_raw_observations() -> None:
    state = _experienced()
    observation = 3.0 + jax.random.normal(jax.random.key(1), (4, 2, OBSERVATION))
    noise = jax.random.normal(jax.random.key(2), (4, 2, U))
    moments = state.normalizer
    normal = np.clip((observation - moments.mean) / np.sqrt(moments.variance), -10.0, 10.0)
    acted = _ppo().learning.networks.act(state.params, normal, ())
    mean, std = acted.mean, acted.std
    action, log_prob, _ = _ppo().act(state, observation, noise)
    # Float32 rounding of the normalisation, through weights of order 1.
    mode, _, _ = _ppo().act(state, observation, jnp.zeros_like(noise))
    np.testing.assert_allclose(mode, mean, atol=1e-5)
    np.testing.assert_allclose(action, mean + std * noise, atol=1e-5)
    np.testing.assert_allclose(
        _ppo().value(state, observation)[0],
        _ppo().learning.networks.value(state.params, normal, (), ())[0],
        atol=1e-5,
    )
    # The standardised action is the noise: -0.5 z**2 - log(std) - 0.5 log(2 pi), summed over U.
    expected = np.sum(-0.5 * noise**2 - np.log(std) - 0.5 * np.log(2.0 * np.pi), axis=-1)
    np.testing.assert_allclose(log_prob, expected, atol=1e-5)


def test_observations_are_cut_at_ten_deviations() -> None:
    far = jnp.array([1e4, -1e4, 10.5])
    np.testing.assert_array_equal(_fresh().normalizer.normalize(far), [10.0, -10.0, 10.0])


def test_the_first_minibatch_starts_at_ratio_one_with_the_old_normalizer() -> None:
    state = _experienced(config=ONE_STEP)
    batch = _batch(state, 1, ONE_STEP)
    shifted = replace(batch, observation=batch.observation + 4.0)
    noise = jax.random.normal(jax.random.key(3), (G, N, U))
    action, log_prob, _ = _ppo(ONE_STEP).act(state, shifted.observation, noise)
    shifted = replace(shifted, action=action, log_prob=log_prob)
    updated, metrics = _update(state, shifted, jax.random.key(2), config=ONE_STEP)
    # exp and log densities round at about 1e-6. With the updated normalizer, the approximate KL
    # divergence would be of order 0.1.
    np.testing.assert_allclose(metrics["approx_kl"], 0.0, atol=1e-5)
    assert metrics["clip_fraction"] == 0.0
    # At ratio 1 the surrogate is the mean of the normalised advantages: 0, up to rounding.
    np.testing.assert_allclose(metrics["policy_loss"], 0.0, atol=1e-5)
    stale = _ppo(ONE_STEP).act(updated, shifted.observation, jnp.zeros((G, N, U)))[0]
    before = replace(updated, normalizer=state.normalizer)
    fresh = _ppo(ONE_STEP).act(before, shifted.observation, jnp.zeros((G, N, U)))[0]
    assert jnp.abs(stale - fresh).max() > 0.1


def test_the_normalizer_takes_in_the_valid_observations_after_the_update() -> None:
    state = _fresh()
    batch = _batch(state)
    updated, _ = _update(state, batch, jax.random.key(1))
    seen = np.asarray(batch.observation, np.float64)[np.asarray(batch.valid)]
    assert updated.normalizer.count == len(seen)
    # Float32 sums of about 35 values of order 3.
    np.testing.assert_allclose(updated.normalizer.mean, seen.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(updated.normalizer.variance, seen.var(axis=0), rtol=1e-5)


def test_advantages_are_normalised_over_the_valid_samples_of_the_batch() -> None:
    state = _experienced()
    batch = _batch(state, 1)
    key = jax.random.key(2)
    _, expected = _update(state, batch, key)
    _, scaled = _update(state, replace(batch, advantage=7.0 * batch.advantage - 30.0), key)
    # 7 a - 30, with a around 5, rounds by 1e-6 of the spread of the advantages.
    np.testing.assert_allclose(scaled["policy_loss"], expected["policy_loss"], atol=1e-5)
    np.testing.assert_allclose(scaled["grad_norm"], expected["grad_norm"], rtol=1e-4)


def test_metrics_of_a_single_step_equal_the_loss_over_the_whole_batch() -> None:
    state = _experienced(config=ONE_STEP)
    batch = _batch(state, 1, ONE_STEP)
    _, metrics = _update(state, batch, jax.random.key(2), config=ONE_STEP)
    valid = np.asarray(batch.valid)
    advantage = np.asarray(batch.advantage)
    inside = advantage[valid]
    minibatch = Batch(
        observation=state.normalizer.normalize(batch.observation)[valid],
        action=batch.action[valid],
        log_prob=batch.log_prob[valid],
        advantage=jnp.asarray((inside - inside.mean()) / inside.std()),
        return_=batch.return_[valid],
        valid=jnp.ones(valid.sum(), bool),
    )
    loss = jax.value_and_grad(gradients.ppo_loss, has_aux=True)
    (_, expected), gradient = jax.jit(loss, static_argnums=(2, 3))(
        state.params,
        minibatch,
        _ppo(ONE_STEP).learning.networks,
        ONE_STEP,
        jnp.float32(valid.sum()),
    )
    for name, metric in expected.items():
        # The same terms, of order 1 to 10, added in another order.
        np.testing.assert_allclose(metrics[name], metric, rtol=1e-5, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(metrics["grad_norm"], optax.tree.norm(gradient), rtol=1e-4)


def test_invalid_samples_may_hold_nan_and_change_nothing() -> None:
    state = _experienced()
    batch = _batch(state, 1)
    key = jax.random.key(2)
    _assert_equal(_update(state, _spoilt(batch, batch.valid), key), _update(state, batch, key))


def test_a_batch_without_a_valid_sample_changes_nothing_at_all() -> None:
    state = _experienced()
    batch = _spoilt(_batch(state, 1), jnp.zeros((G, N), bool))
    updated, metrics = _update(state, batch, jax.random.key(2))
    _assert_equal(updated, state)
    std = metrics.pop("std")
    np.testing.assert_allclose(std, jnp.exp(state.params["actor"]["log_std"]).mean(), rtol=1e-6)
    assert metrics
    assert all(metric == 0.0 for metric in metrics.values())


def test_minibatches_without_a_valid_sample_are_no_steps() -> None:
    state = _fresh()
    batch = _batch(state)
    # All valid samples are in two of eight groups, so at most two of an epoch's four minibatches
    # take a step.
    valid = jnp.zeros((G, N), bool).at[0].set(True).at[5].set(True)
    updated, _ = _update(state, _spoilt(batch, valid), jax.random.key(1))
    steps = optax.tree.get_all_with_path(updated.optimizer_state, "count")
    orders = [
        jax.random.permutation(key, G).reshape(CONFIG.num_minibatches, -1)
        for key in jax.random.split(jax.random.key(1), CONFIG.epochs)
    ]
    expected = sum(int(np.isin(order, [0, 5]).any(axis=1).sum()) for order in orders)
    assert expected < CONFIG.epochs * CONFIG.num_minibatches
    assert [int(count) for _, count in steps] == [expected] * 4


def test_each_epoch_learns_from_every_group_once() -> None:
    state = _fresh()
    batch = _batch(state)
    config = AlgoConfig(hidden_sizes=(8,), epochs=2, num_minibatches=4, critic_learning_rate=1e-12)
    # The critic does not change, so the value loss is the mean over all samples exactly if each
    # epoch visits each group once. With returns of 2**g, every choice of groups has its own sum.
    returns = jnp.broadcast_to(2.0 ** jnp.arange(G)[:, None], (G, N))
    batch = replace(batch, return_=returns, valid=jnp.ones((G, N), bool))
    _, metrics = _update(state, batch, jax.random.key(1), config=config)
    value, _ = _ppo(config).value(state, batch.observation)
    # Float32 means of squares up to 128**2.
    np.testing.assert_allclose(
        metrics["value_loss"], 0.5 * np.mean((value - returns) ** 2), rtol=1e-5
    )


def test_actor_and_critic_move_at_their_own_learning_rates() -> None:
    state = _fresh(config=ONE_STEP)
    updated, _ = _update(state, _batch(state, 0, ONE_STEP), jax.random.key(1), config=ONE_STEP)
    moves = _step_sizes(state.params, updated.params)
    # Adam's first step is rate * g / (|g| + 1e-5): the rate, less a share of about 1e-5 / |g|. The
    # largest |g| of each network is at least 1e-3 here, so the share is at most 1e-2.
    rates = optimizer.learning_rates(ONE_STEP, UPDATES)
    np.testing.assert_allclose(moves["actor"], rates["actor"], rtol=1e-2)
    np.testing.assert_allclose(moves["critic"], rates["critic"], rtol=1e-2)


def test_one_norm_clips_the_gradient_of_both_networks() -> None:
    state = _fresh(config=ONE_STEP)
    updated, metrics = _update(
        state, _batch(state, 0, ONE_STEP), jax.random.key(1), config=ONE_STEP
    )
    limit = ONE_STEP.max_grad_norm
    assert limit is not None
    assert metrics["grad_norm"] > limit
    # After the first step, Adam's mean is 0.1 times the gradient that Adam was given.
    momentum = [mu for _, mu in optax.tree.get_all_with_path(updated.optimizer_state, "mu")]
    # Float32 rounding of a sum of squares.
    np.testing.assert_allclose(optax.tree.norm(momentum), 0.1 * limit, rtol=1e-5)


def test_linear_schedule_falls_to_zero_over_the_run_and_constant_does_not() -> None:
    constant = AlgoConfig(
        hidden_sizes=(8,), epochs=1, num_minibatches=1, learning_rate_schedule="constant"
    )
    state = _fresh(config=ONE_STEP)
    for done in range(UPDATES + 1):
        batch = _batch(state, done, ONE_STEP)
        key = jax.random.key(done)
        linear_state, _ = _update(state, batch, key, config=ONE_STEP)
        constant_state, _ = _update(state, batch, key, config=constant)
        linear = _step_sizes(state.params, linear_state.params)
        full = _step_sizes(state.params, constant_state.params)
        for network in ("actor", "critic"):
            # A change of 1e-4 in a parameter of order 1 has a relative error of
            # 2**-24 / 1e-4 = 6e-4.
            np.testing.assert_allclose(
                linear[network], (1.0 - done / UPDATES) * full[network], rtol=3e-3, atol=1e-9
            )
        state = linear_state


def test_same_inputs_give_the_same_bits_and_another_key_does_not() -> None:
    state = _experienced()
    batch = _batch(state, 1)
    first = _update(state, batch, jax.random.key(2))
    _assert_equal(_update(state, batch, jax.random.key(2)), first)
    other, _ = _update(state, batch, jax.random.key(3))
    assert np.any(other.params["actor"]["log_std"] != first[0].params["actor"]["log_std"])


@pytest.mark.slow
def test_any_split_of_a_compiled_loop_gives_the_same_bits() -> None:
    traces = []

    @jax.jit
    def chunk(state: LearnerState, start: int, stop: int) -> LearnerState:
        traces.append(None)

        def body(index: jax.Array, state: LearnerState) -> LearnerState:
            key = jax.random.fold_in(jax.random.key(1), index)
            return _ppo().update(state, _batch(_fresh(), 1), key)[0]

        return jax.lax.fori_loop(start, stop, body, state)

    state = _fresh()
    for start in range(4):
        state = chunk(state, start, start + 1)
    _assert_equal(chunk(_fresh(), 0, 4), state)
    assert len(traces) == 1


@pytest.mark.slow
def test_learners_under_vmap_equal_single_ones() -> None:
    states = [_experienced(seed) for seed in range(3)]
    batches = [_batch(state, seed) for seed, state in enumerate(states)]
    # The robot of one learner is absent, as in the first stage of a curriculum.
    batches[1] = _spoilt(batches[1], jnp.zeros((G, N), bool))
    keys = jax.random.split(jax.random.key(5), 3)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    stacked_batch = jax.tree.map(lambda *x: jnp.stack(x), *batches)
    together, metrics = jax.vmap(_update)(stacked, stacked_batch, keys)
    for i in range(3):
        alone, alone_metrics = _update(states[i], batches[i], keys[i])
        # A batched matrix product adds in another order, with a relative error of 1e-6. Twelve
        # Adam steps of at most 1e-3 turn the error into 1e-5 of a step; parameters are of order 1.
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-4, atol=2e-5),
            (together, metrics),
            (alone, alone_metrics),
        )
    _assert_equal(jax.tree.map(lambda x: x[1], together), states[1])


def test_initialised_under_vmap_each_learner_is_its_own() -> None:
    keys = jax.random.split(jax.random.key(0), 2)
    states = jax.vmap(_ppo().init)(keys)
    kernel = states.params["actor"]["mean"]["kernel"]
    assert kernel.shape == (2, 8, U)
    assert np.all(kernel[0] != kernel[1])


@pytest.mark.parametrize("field", ["return_", "log_prob", "action", "observation"])
def test_shapes_that_would_broadcast_are_refused(field: str) -> None:
    state = _fresh()
    batch = _batch(state)
    with pytest.raises(AssertionError):
        _update(state, replace(batch, **{field: getattr(batch, field)[:, :1]}), jax.random.key(0))


def test_minibatches_that_do_not_divide_the_groups_are_refused() -> None:
    state = _fresh()
    config = AlgoConfig(hidden_sizes=(8,), num_minibatches=3)
    with pytest.raises(AssertionError):
        _update(state, _batch(state), jax.random.key(0), config=config)


def test_without_a_norm_the_gradient_is_not_clipped() -> None:
    config = replace(ONE_STEP, max_grad_norm=None)
    state = _fresh(config=config)
    updated, metrics = _update(state, _batch(state, 0, config), jax.random.key(1), config=config)
    momentum = [mu for _, mu in optax.tree.get_all_with_path(updated.optimizer_state, "mu")]
    assert metrics["grad_norm"] > 0.5
    # After the first step, Adam's mean is 0.1 times the gradient, up to float32 rounding.
    np.testing.assert_allclose(optax.tree.norm(momentum), 0.1 * metrics["grad_norm"], rtol=1e-5)


def test_adam_takes_its_epsilon_from_the_config() -> None:
    config = replace(ONE_STEP, adam_epsilon=10.0, max_grad_norm=None)
    state = _fresh(config=config)
    updated, metrics = _update(state, _batch(state, 0, config), jax.random.key(1), config=config)
    # A step of rate * g / (|g| + 10) is at most a tenth of the rate times the norm of g, which is
    # far below the rate itself.
    move = _step_sizes(state.params, updated.params)["critic"]
    rate = optimizer.learning_rates(config, UPDATES)["critic"]
    assert 0.0 < move < 0.1 * rate * float(metrics["grad_norm"])
    assert move < 0.5 * rate


@pytest.mark.slow
def test_observations_may_be_left_as_they_are() -> None:
    config = replace(ONE_STEP, normalize_observations=False)
    state = _fresh(config=config)
    updated, _ = _update(state, _batch(state, 0, config), jax.random.key(1), config=config)
    _assert_equal(updated.normalizer, state.normalizer)
    seen = jnp.array([4.0, -3.25, 0.5])
    np.testing.assert_array_equal(updated.normalizer.normalize(seen), seen)


def test_advantages_of_monte_carlo_returns_are_taken_as_they_are() -> None:
    config = replace(ONE_STEP, advantage="monte_carlo")
    state = _fresh(config=config)
    batch = _batch(state, 0, config)
    _, metrics = _update(state, batch, jax.random.key(1), config=config)
    # At ratio 1 the policy loss is minus the mean advantage of about 5, up to float32 rounding.
    mean = np.mean(np.asarray(batch.advantage)[np.asarray(batch.valid)])
    np.testing.assert_allclose(metrics["policy_loss"], -mean, rtol=1e-5)


# Numbers that are not finite


def _break(x: jax.Array, value: float) -> jax.Array:
    return x.at[(0,) * x.ndim].set(value) if x.dtype == jnp.float32 and x.ndim else x


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("field", ["observation", "action", "log_prob", "advantage", "return_"])
def test_a_sample_that_is_not_finite_is_left_out(field: str, value: float) -> None:
    state, key = _experienced(), jax.random.key(1)
    batch = _batch(state)
    batch = replace(batch, valid=batch.valid.at[0, 0].set(True))
    spoilt = replace(batch, **{field: getattr(batch, field).at[0, 0].set(value)})
    without = replace(batch, valid=batch.valid.at[0, 0].set(False))
    found, expected = _update(state, spoilt, key), _update(state, without, key)
    _assert_equal(found, expected)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("part", ["params", "optimizer_state"])
def test_steps_from_a_broken_learner_are_all_skipped_and_counted(part: str, value: float) -> None:
    state = _experienced()
    broken = jax.tree.map(lambda x: _break(x, value), getattr(state, part))
    state = replace(state, **{part: broken})
    after, metrics = _update(state, _batch(state), jax.random.key(1))
    _assert_equal((after.params, after.optimizer_state), (state.params, state.optimizer_state))
    assert metrics["skipped_steps"] == CONFIG.epochs * CONFIG.num_minibatches
    assert metrics["policy_loss"] == -np.inf
    assert np.isfinite(after.normalizer.mean).all()


def test_a_batch_of_which_no_sample_is_finite_counts_as_skipped() -> None:
    state = _experienced()
    batch = _batch(state)
    spoilt = replace(batch, advantage=batch.advantage * jnp.nan)
    after, metrics = _update(state, spoilt, jax.random.key(1))
    _assert_equal(after, state)
    assert metrics["skipped_steps"] == CONFIG.epochs * CONFIG.num_minibatches
    assert metrics["policy_loss"] == -np.inf
