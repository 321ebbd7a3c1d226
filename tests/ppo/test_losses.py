"""Checks the loss against NumPy, with masks."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest
import scipy.stats
from flax import traverse_util

from swarmjax.ppo import gradients
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.gradients import ppo_loss

B, OBSERVATION, U = 24, 3, 2
CONFIG = AlgoConfig(hidden_sizes=(8,), clip_epsilon=0.2, value_cost=0.7, entropy_cost=0.03)
NETS = learners.nets(CONFIG, OBSERVATION, U)
PARAMS = jax.jit(NETS.init)(jax.random.key(0))
PARAMS["actor"]["mean"]["kernel"] *= 150.0  # so that means lie on both sides of -1 and of 1
_loss = jax.jit(ppo_loss, static_argnums=(2, 3))


@pytest.fixture(autouse=True)
def _bound_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keeps the bound term from hiding the other terms."""
    monkeypatch.setattr(gradients, "BOUND_COST", 0.4)


def _minibatch(valid_share: float = 0.6) -> Batch:
    random = np.random.default_rng(0)
    observation = random.normal(size=(B, OBSERVATION)).astype(np.float32)
    action = random.normal(size=(B, U)).astype(np.float32)
    mean, std, *_ = NETS.act(PARAMS, observation, ())
    log_prob = np.asarray(gradients.log_density(mean, std, action))
    return Batch(
        observation=observation,
        action=action,
        # Ratios range from e**-0.9 to e**0.9, so many lie below 0.8 and many above 1.2.
        log_prob=log_prob + random.normal(size=B).clip(-3, 3).astype(np.float32) * 0.3,
        advantage=random.normal(size=B).astype(np.float32),
        return_=random.normal(size=B).astype(np.float32),
        valid=random.random(B) < valid_share,
    )


def _expected(minibatch: Batch, expected_valid: float) -> dict[str, float]:
    mean, std, *_ = NETS.act(PARAMS, minibatch.observation, ())
    value = np.asarray(NETS.value(PARAMS, minibatch.observation, (), ())[0], np.float64)
    log_prob = scipy.stats.norm.logpdf(minibatch.action, mean, std).sum(axis=-1)
    total = dict.fromkeys(
        ("policy_loss", "value_loss", "bound_loss", "entropy", "approx_kl", "clip_fraction"), 0.0
    )
    for i in np.flatnonzero(minibatch.valid):
        ratio = np.exp(log_prob[i] - minibatch.log_prob[i])
        advantage = minibatch.advantage[i]
        total["policy_loss"] -= min(ratio * advantage, np.clip(ratio, 0.8, 1.2) * advantage)
        total["value_loss"] += (value[i] - minibatch.return_[i]) ** 2 / 2
        total["bound_loss"] += sum(max(abs(x) - 1, 0) ** 2 for x in np.asarray(mean[i], np.float64))
        total["entropy"] += scipy.stats.norm.entropy(scale=std).sum()
        total["approx_kl"] += ratio - 1 - np.log(ratio)
        total["clip_fraction"] += abs(ratio - 1) > 0.2
    parts = {name: part / max(expected_valid, 1.0) for name, part in total.items()}
    parts["loss"] = parts["policy_loss"] + 0.7 * parts["value_loss"] - 0.03 * parts["entropy"]
    parts["loss"] += 0.4 * parts["bound_loss"]
    return parts


# With 0.25 expected valid samples, the sums are divided by 1.
@pytest.mark.parametrize("expected_valid", [0.25, 5.0, 14.0])
def test_loss_and_its_parts_equal_numpy(expected_valid: float) -> None:
    minibatch = _minibatch()
    loss, metrics = _loss(PARAMS, minibatch, NETS, CONFIG, jnp.float32(expected_valid))
    expected = _expected(minibatch, expected_valid)
    assert expected["clip_fraction"] > 0.0
    assert expected["bound_loss"] > 0.0
    # Sums of 24 float32 terms of order 1 against float64.
    np.testing.assert_allclose(loss, expected.pop("loss"), rtol=1e-5, atol=1e-5)
    assert metrics.keys() == expected.keys()
    for name, part in expected.items():
        np.testing.assert_allclose(metrics[name], part, rtol=1e-5, atol=1e-5, err_msg=name)


def test_a_clipped_ratio_has_no_gradient_and_an_unclipped_one_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    minibatch = _minibatch()
    mean, std, *_ = NETS.act(PARAMS, minibatch.observation, ())
    log_prob = gradients.log_density(mean, std, minibatch.action)
    config = AlgoConfig(hidden_sizes=(8,), clip_epsilon=0.2, entropy_cost=0.0)
    monkeypatch.setattr(gradients, "BOUND_COST", 0.0)
    loss = jax.jit(jax.grad(ppo_loss, has_aux=True), static_argnums=(2, 3))

    def slope(ratio: float, advantage: float) -> float:
        samples = replace(
            minibatch,
            log_prob=log_prob - np.log(ratio),
            advantage=np.full(B, advantage, np.float32),
            valid=np.ones(B, bool),
        )
        gradient, _ = loss(PARAMS, samples, NETS, config, jnp.float32(B))
        return float(jnp.abs(gradient["actor"]["mean"]["kernel"]).max())

    # The minimum in equation 7 of the PPO paper is flat only where the ratio has left the clip
    # range and a further move would raise the surrogate.
    assert slope(1.3, 1.0) == 0.0
    assert slope(0.7, -1.0) == 0.0
    assert slope(1.3, -1.0) > 0.0
    assert slope(0.7, 1.0) > 0.0


def test_without_a_valid_sample_loss_and_gradient_are_zero() -> None:
    minibatch = _minibatch(valid_share=0.0)
    # The log ratio is about 1000: if it were masked only after exp, its gradient would be NaN.
    minibatch = replace(minibatch, log_prob=minibatch.log_prob - 1000.0)
    (loss, metrics), gradient = jax.value_and_grad(ppo_loss, has_aux=True)(
        PARAMS, minibatch, NETS, CONFIG, jnp.float32(0.0)
    )
    for leaf in jax.tree.leaves((loss, metrics, gradient)):
        np.testing.assert_array_equal(leaf, np.zeros(leaf.shape))


def test_float_masks_count_as_boolean_ones() -> None:
    minibatch = _minibatch()
    expected = _loss(PARAMS, minibatch, NETS, CONFIG, jnp.float32(14.0))
    got = _loss(
        PARAMS,
        replace(minibatch, valid=minibatch.valid.astype(np.float32)),
        NETS,
        CONFIG,
        jnp.float32(14.0),
    )
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def test_mean_over_unevenly_filled_minibatches_is_the_loss_of_the_batch() -> None:
    batch = _minibatch()
    valid = np.zeros(B, bool)
    valid[[0, 1, 2, 3, 4, 5, 6, 7, 9]] = True
    batch = replace(batch, valid=valid)
    loss = jax.jit(jax.value_and_grad(ppo_loss, has_aux=True), static_argnums=(2, 3))
    whole = loss(PARAMS, batch, NETS, CONFIG, jnp.float32(9.0))
    # Three minibatches of eight samples have 8, 1 and 0 valid samples; each expects 9 / 3 = 3.
    parts = [
        loss(
            PARAMS,
            jax.tree.map(lambda x, start=start: x[start : start + 8], batch),
            NETS,
            CONFIG,
            jnp.float32(3.0),
        )
        for start in (0, 8, 16)
    ]
    mean = jax.tree.map(lambda *part: sum(part) / 3.0, *parts)
    # The same float32 terms of order 1, added in another order.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6), mean, whole)


def test_shapes_that_would_broadcast_are_refused() -> None:
    minibatch = _minibatch()
    with pytest.raises(AssertionError):
        ppo_loss(
            PARAMS,
            replace(minibatch, return_=minibatch.return_[:, None]),
            NETS,
            CONFIG,
            jnp.float32(1.0),
        )


def test_the_guess_of_the_state_is_charged_by_its_squared_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    size = 5
    config = replace(CONFIG, critic="state")
    nets = learners.nets(config, OBSERVATION, U, size)
    params = jax.jit(nets.init)(jax.random.key(0))
    state = np.random.default_rng(1).normal(size=(B, size)).astype(np.float32)
    minibatch = replace(_minibatch(), state=state)
    count = jnp.float32(14.0)
    loss, metrics = _loss(params, minibatch, nets, config, count)
    monkeypatch.setattr(gradients, "GUESS_COST", 0.0)
    free, _ = ppo_loss(params, minibatch, nets, config, count)  # traced with the new cost
    flat = traverse_util.flatten_dict(params["actor"], sep="/")
    layers = {name: np.asarray(x, np.float64) for name, x in flat.items()}
    hidden = np.tanh(
        minibatch.observation @ layers["torso/hidden_0/kernel"] + layers["torso/hidden_0/bias"]
    )
    error = hidden @ layers["guess/kernel"] + layers["guess/bias"] - state
    expected = (error[minibatch.valid] ** 2).sum() / 14.0
    np.testing.assert_allclose(metrics["guess_loss"], expected, rtol=1e-5)  # float32
    np.testing.assert_allclose(loss - free, 0.02 * expected, rtol=1e-5)
