"""Checks the networks against a forward pass in NumPy, and the Gaussian against SciPy."""

import hypothesis
import hypothesis.extra.numpy as hypothesis_numpy
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest
import scipy.stats
from flax import errors

from swarmjax.ppo import gradients, networks
from swarmjax.ppo.config import AlgoConfig

OBSERVATION, U = 3, 2
CONFIG = AlgoConfig(hidden_sizes=(8, 5), initial_std=0.6)
ACTIVATIONS = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "swish": lambda x: x / (1.0 + np.exp(-x)),
}


def _nets(config: AlgoConfig = CONFIG) -> networks.Networks:
    return learners.nets(config, OBSERVATION, U)


def _params(config: AlgoConfig = CONFIG) -> networks.Params:
    return _nets(config).init(jax.random.key(0))


def _forward(network: networks.Params, activation: str, head: str, x: np.ndarray) -> np.ndarray:
    network = jax.tree.map(np.asarray, network)
    for name in ("hidden_0", "hidden_1"):
        layer = network["torso"][name]
        x = ACTIVATIONS[activation](x @ layer["kernel"] + layer["bias"])
    return x @ network[head]["kernel"] + network[head]["bias"]


@pytest.mark.parametrize(
    ("network", "path", "gain"),
    [
        ("actor", ("torso", "hidden_0"), np.sqrt(2.0)),
        ("actor", ("torso", "hidden_1"), np.sqrt(2.0)),
        ("actor", ("mean",), 0.01),
        ("critic", ("torso", "hidden_0"), np.sqrt(2.0)),
        ("critic", ("torso", "hidden_1"), np.sqrt(2.0)),
        ("critic", ("value",), 0.01),
    ],
)
def test_layers_start_orthogonal_with_their_gain_and_no_bias(
    network: str, path: tuple[str, ...], gain: float
) -> None:
    layer = _params()[network]
    for name in path:
        layer = layer[name]
    kernel = np.asarray(layer["kernel"])
    rows, columns = kernel.shape
    gram = kernel.T @ kernel if rows >= columns else kernel @ kernel.T
    # A QR decomposition in float32 is orthogonal to about 1e-6.
    np.testing.assert_allclose(gram / gain**2, np.eye(min(rows, columns)), atol=5e-6)
    np.testing.assert_array_equal(layer["bias"], np.zeros(columns))


def test_std_starts_at_the_configured_one_for_every_observation() -> None:
    observation = jax.random.normal(jax.random.key(1), (4, 6, OBSERVATION))
    mean, std, *_ = _nets().act(_params(), observation, ())
    assert mean.shape == (4, 6, U)
    # log and exp in float32.
    np.testing.assert_allclose(std, [0.6, 0.6], rtol=1e-6)


@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
def test_networks_equal_a_forward_pass_in_numpy(activation: str) -> None:
    config = AlgoConfig(hidden_sizes=(8, 5), activation=activation)
    params = _params(config)
    observation = np.asarray(jax.random.normal(jax.random.key(1), (4, 6, OBSERVATION)))
    mean = _nets(config).act(params, observation, ()).mean
    value, _ = _nets(config).value(params, observation, (), ())
    # Sums of at most eight float32 products of order 1; the means themselves are of order 0.01.
    np.testing.assert_allclose(
        mean, _forward(params["actor"], activation, "mean", observation), atol=1e-7
    )
    np.testing.assert_allclose(
        value, _forward(params["critic"], activation, "value", observation)[..., 0], atol=2e-6
    )


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(
    mean=hypothesis_numpy.arrays(np.float32, (4, U), elements=st.floats(-3, 3, width=32)),
    action=hypothesis_numpy.arrays(np.float32, (4, U), elements=st.floats(-3, 3, width=32)),
    std=hypothesis_numpy.arrays(np.float32, (U,), elements=st.floats(0.125, 4, width=32)),
)
def test_log_prob_equals_scipy(mean: np.ndarray, action: np.ndarray, std: np.ndarray) -> None:
    expected = scipy.stats.norm.logpdf(action, mean, std).sum(axis=-1)
    # float32 relative rounding of terms up to 0.5 * (6 / 0.125)**2 = 1152.
    np.testing.assert_allclose(
        gradients.log_density(mean, std, action), expected, rtol=1e-5, atol=1e-5
    )


def test_entropy_equals_scipy() -> None:
    std = np.array([0.2, 1.7], np.float32)
    # float32 rounding of terms of order 1.
    np.testing.assert_allclose(
        gradients.entropy(std), scipy.stats.norm.entropy(scale=std).sum(), atol=1e-6
    )


def test_actor_and_critic_share_nothing() -> None:
    observation = np.ones((1, OBSERVATION), np.float32)
    gradient = jax.grad(lambda params: _nets().value(params, observation, (), ())[0][0])(_params())
    assert all(np.all(np.asarray(leaf) == 0.0) for leaf in jax.tree.leaves(gradient["actor"]))
    assert np.any(np.asarray(gradient["critic"]["torso"]["hidden_0"]["kernel"]) != 0.0)


def test_wrong_observation_size_is_refused() -> None:
    wrong = np.zeros((2, OBSERVATION + 1), np.float32)
    with pytest.raises(errors.ScopeParamShapeError):
        _nets().act(_params(), wrong, ())
    with pytest.raises(errors.ScopeParamShapeError):
        _nets().value(_params(), wrong, (), ())


def test_pytorchs_initialisation_spreads_weights_and_biases_by_their_inputs() -> None:
    config = AlgoConfig(hidden_sizes=(64, 32), initialization="uniform")
    params = learners.nets(config, 100, 50).init(jax.random.key(0))
    for network, last in (("actor", "mean"), ("critic", "value")):
        torso = params[network]["torso"]
        layers = (torso["hidden_0"], torso["hidden_1"], params[network][last])
        for layer, inputs in zip(layers, (100, 64, 32), strict=True):
            bound = 1.0 / np.sqrt(inputs)
            kernel, bias = np.asarray(layer["kernel"]), np.asarray(layer["bias"])
            assert kernel.shape[0] == inputs
            assert np.abs(kernel).max() <= bound
            assert np.abs(bias).max() <= bound
            assert np.abs(bias).max() > 0.0
            # At least 32 draws from U(-b, b) have the deviation b / sqrt(3), within five standard
            # errors.
            apart = abs(kernel.std() - bound / np.sqrt(3.0))
            assert apart < 5.0 * bound / np.sqrt(kernel.size)
            assert kernel.max() > 0.7 * bound > -0.7 * bound > kernel.min()


def test_an_output_of_tanh_keeps_the_mean_within_the_commands() -> None:
    linear = AlgoConfig(hidden_sizes=(8,))
    params = _nets(linear).init(jax.random.key(0))
    params["actor"]["mean"]["kernel"] *= 300.0
    observation = jax.random.normal(jax.random.key(1), (5, 3))
    mean, std, *_ = _nets(linear).act(params, observation, ())
    bounded = _nets(AlgoConfig(hidden_sizes=(8,), mean_activation="tanh"))
    squashed, same, *_ = bounded.act(params, observation, ())
    assert np.abs(mean).max() > 1.0
    np.testing.assert_allclose(squashed, np.tanh(mean), rtol=1e-6)  # float32
    np.testing.assert_array_equal(same, std)


@pytest.mark.parametrize(("exploration", "moves"), [("learned", True), ("scheduled", False)])
def test_no_gradient_reaches_a_scheduled_deviation(exploration: str, moves: bool) -> None:
    config = AlgoConfig(hidden_sizes=(8,), exploration=exploration)
    params = _params(config)

    def total(params: networks.Params) -> jax.Array:
        return _nets(config).act(params, jnp.ones(3), ()).std.sum()

    assert bool(jax.grad(total)(params)["actor"]["log_std"].any()) is moves
