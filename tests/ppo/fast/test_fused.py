"""Checks that the kernels compute the gradient of the loss, in interpret mode without a GPU."""

import functools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import chex
import hypothesis
import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest
from hypothesis import strategies as st
from jax.sharding import AbstractDevice, AbstractMesh

from swarmjax.ppo import gradients
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.dispatch import Backend
from swarmjax.ppo.fast import fused, kernel
from swarmjax.ppo.fast.kernel import Launch
from swarmjax.ppo.networks import Networks, Params, Sizes
from swarmjax.ppo.ppo import PPO, LearnerState

OBSERVATION, ACTION = 10, 2
SMALL = AlgoConfig(hidden_sizes=(16,), entropy_cost=0.02, value_cost=0.7)
# The kernels sum float32 terms in another order and use exp(-log_std) for 1 / std. Log
# probabilities reach -41, so they and the ratios have rounding errors of about 4e-6, and terms of
# opposite sign cancel. The measured relative error is at most 8e-6.
RELATIVE = 5e-5
H100 = AbstractDevice(device_kind="NVIDIA H100 80GB HBM3", num_cores=132, platform="gpu")


def _nets(config: AlgoConfig) -> Networks:
    return learners.nets(config, OBSERVATION, ACTION)


def _ppo(config: AlgoConfig, backend: Backend = "fused") -> PPO:
    return learners.ppo(config, Sizes(OBSERVATION, ACTION), 5, backend)


def _params(config: AlgoConfig, seed: int = 0) -> Params:
    """Returns parameters without zeros; their mean actions lie inside and outside -1..1."""
    shapes = jax.eval_shape(lambda: _nets(config).init(jax.random.key(0)))
    random = np.random.default_rng(seed)
    params = jax.tree.map(lambda x: 0.3 * random.normal(size=x.shape).astype(np.float32), shapes)
    # Means of equal spread for each width: a log probability L has a rounding error of about
    # 1e-7 L, and so has the ratio.
    params["actor"]["mean"]["kernel"] *= 12.0 / np.sqrt(config.hidden_sizes[-1])
    return params


@functools.partial(jax.jit, static_argnums=1)
def _log_prob(
    params: Params, config: AlgoConfig, observation: jax.Array, action: jax.Array
) -> jax.Array:
    acted = _nets(config).act(params, observation, ())
    return gradients.log_density(acted.mean, acted.std, action)


def _minibatch(params: Params, config: AlgoConfig, size: int, seed: int = 0) -> Batch:
    """Returns samples; about a third are invalid, and about half have a clipped ratio."""
    random = np.random.default_rng(seed)
    observation = random.normal(size=(size, OBSERVATION)).astype(np.float32)
    action = random.normal(size=(size, ACTION)).astype(np.float32)
    log_prob = _log_prob(params, config, observation, action) + 0.3 * random.normal(size=size)
    return Batch(
        observation=observation,
        action=action,
        log_prob=np.asarray(log_prob, np.float32),
        advantage=random.normal(size=size).astype(np.float32),
        return_=random.normal(size=size).astype(np.float32),
        valid=(random.uniform(size=size) < 0.7) | (np.arange(size) == 0),
    )


def _expected(params: Params, minibatch: Batch, config: AlgoConfig, count: float) -> Any:
    """Returns the gradient and the metrics of autodiff."""
    with jax.default_matmul_precision("highest"):
        gradient = jax.grad(gradients.ppo_loss, has_aux=True)
        valid = jnp.float32(count)
        return jax.jit(gradient, static_argnums=(2, 3))(
            params, minibatch, _nets(config), config, valid
        )


@functools.partial(jax.jit, static_argnums=(2, 4))
def _fused(params: Params, minibatch: Batch, config: AlgoConfig, count: Any, launch: Launch) -> Any:
    with jax.default_matmul_precision("highest"), pytest.MonkeyPatch.context() as patch:
        learners.interpret_kernels(patch)
        return _gradient(params, minibatch, config, count, launch=launch)


def _gradient(
    params: Params,
    minibatch: Batch,
    config: AlgoConfig,
    count: Any,
    *,
    launch: Launch | None = None,
) -> Any:
    """Computes with the kernels what `jax.grad(gradients.ppo_loss, has_aux=True)` does."""
    sizes = minibatch.observation.shape[1], minibatch.action.shape[1]
    launch = fused.choose_launch(config, *sizes) if launch is None else launch
    tiles = -(-len(minibatch.valid) // launch.tile)
    found, metrics, _ = fused.flat_gradient(
        fused.flatten(params),
        fused.layouts(params),
        replace(minibatch, valid=minibatch.valid.astype(bool).astype(jnp.float32)),
        kernel.Tiles(jnp.arange(tiles), jnp.array([0, tiles])),
        config,
        count,
        launch=launch,
    )
    return fused.unflatten(found, params), metrics


def _assert_close(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for (path, mine), theirs in zip(
        jax.tree.leaves_with_path(found), jax.tree.leaves(expected), strict=True
    ):
        error = np.linalg.norm(np.asarray(mine) - theirs)
        assert error <= RELATIVE * np.linalg.norm(theirs), jax.tree_util.keystr(path)


@pytest.mark.parametrize(
    ("changes", "launch", "size", "count"),
    [
        # Seven tiles for three programs: two programs have no tile left in the last round. The
        # last tile holds 8 samples.
        pytest.param(
            {"hidden_sizes": (64, 64)}, Launch(32, 3, 4), 200, 140.0, marks=pytest.mark.slow
        ),
        ({"hidden_sizes": (32,), "activation": "relu"}, Launch(16, 4, 4), 70, 140.0),
        pytest.param(
            {"hidden_sizes": (16, 32, 16), "activation": "swish"},
            Launch(16, 100, 4),
            64,
            60.0,
            marks=pytest.mark.slow,
        ),
        ({"exploration": "scheduled"}, Launch(64, 1, 4), 65, 40.0),
        pytest.param(
            {"mean_activation": "tanh"}, Launch(32, 2, 4), 40, 30.0, marks=pytest.mark.slow
        ),
        # With 0.25 expected valid samples, the sums are divided by 1.
        ({"clip_epsilon": 0.3}, Launch(32, 2, 4), 9, 0.25),
    ],
)
def test_gradient_and_metrics_are_those_of_autodiff(
    changes: dict[str, Any], launch: Launch, size: int, count: float
) -> None:
    config = replace(SMALL, **changes)
    params = _params(config)
    minibatch = _minibatch(params, config, size)
    expected = _expected(params, minibatch, config, count)
    assert 0.0 < expected[1]["clip_fraction"] * max(count, 1.0) < np.sum(minibatch.valid)
    assert (expected[1]["bound_loss"] > 0.0) == (config.mean_activation == "linear")
    _assert_close(_fused(params, minibatch, config, count, launch), expected)


def test_float_masks_count_as_boolean_ones() -> None:
    params = _params(SMALL)
    minibatch = _minibatch(params, SMALL, 40)
    masked = replace(minibatch, valid=3.0 * minibatch.valid)
    expected = _expected(params, minibatch, SMALL, 25.0)
    _assert_close(_fused(params, masked, SMALL, 25.0, Launch(32, 2, 4)), expected)


def test_without_a_valid_sample_all_is_zero() -> None:
    params = _params(SMALL)
    minibatch = _minibatch(params, SMALL, 40)
    # The log ratio is about 1000: if it were masked only after exp, its gradient would be NaN.
    minibatch = replace(
        minibatch, valid=np.zeros(40, bool), log_prob=minibatch.log_prob - np.float32(1000.0)
    )
    for leaf in jax.tree.leaves(_fused(params, minibatch, SMALL, 0.0, Launch(32, 2, 4))):
        np.testing.assert_array_equal(leaf, np.zeros(leaf.shape))


def _several(*lead: int) -> tuple[Params, Batch, jax.Array]:
    """Returns parameters, samples and expected counts, each with these leading axes."""
    number = int(np.prod(lead))
    params = [_params(SMALL, seed) for seed in range(number)]
    batches = [_minibatch(p, SMALL, 40, seed) for seed, p in enumerate(params)]
    stacked = jax.tree.map(
        lambda *x: jnp.stack(x).reshape(*lead, *x[0].shape), *zip(params, batches, strict=True)
    )
    return *stacked, 20.0 + jnp.arange(number, dtype=jnp.float32).reshape(lead)


@pytest.mark.parametrize("lead", [pytest.param((3,), marks=pytest.mark.slow), (2, 2)])
def test_learners_and_seeds_side_by_side_come_to_what_each_does_alone(lead: tuple[int]) -> None:
    several, launch = _several(*lead), Launch(32, 2, 4)
    together = lambda p, m, n: _fused(p, m, SMALL, n, launch)  # noqa: E731 - wrapped below
    for _ in lead:
        together = jax.vmap(together)
    found = together(*several)
    for index in np.ndindex(lead):
        params, minibatch, count = jax.tree.map(lambda x, i=index: x[i], several)
        alone = _fused(params, minibatch, SMALL, count, launch)
        _assert_close(jax.tree.map(lambda x, i=index: x[i], found), alone)


def _lowered(function: Any, *arguments: Any) -> str:
    """Returns the text of the program that JAX lowers for a GPU."""
    with jax.sharding.use_abstract_mesh(AbstractMesh((), (), abstract_device=H100)):
        traced = jax.jit(function).trace(*arguments)
        return traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
@pytest.mark.parametrize(("launch", "tiles"), [(fused.LAUNCH, 16), (fused.LARGE, 8)])
def test_triton_knows_all_that_the_kernels_do(activation: Any, launch: Launch, tiles: int) -> None:
    config = AlgoConfig(activation=activation)
    params = _params(config)
    minibatch = _minibatch(params, config, 1000)
    text = _lowered(
        lambda p, m: _gradient(p, m, config, jnp.float32(700.0), launch=launch),
        params,
        minibatch,
    )
    # The actor's kernel and the critic's kernel each take 1,000 samples in tiles of 64 or 128.
    assert text.count("__gpu$xla.gpu.triton") == 2
    assert text.count(f"grid_x = {tiles} : i32") == 2


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_triton_takes_learners_and_seeds_as_further_axes_of_its_grid() -> None:
    function = jax.vmap(jax.vmap(lambda p, m, n: _gradient(p, m, SMALL, n)))
    text = _lowered(function, *_several(2, 3))
    assert text.count("grid_x = 1 : i32, grid_y = 3 : i32, grid_z = 2 : i32") == 2


@pytest.mark.parametrize(("precision", "of_all"), [("highest", True), (None, False)])
def test_products_have_the_precision_that_jax_is_set_to(
    precision: str | None, of_all: bool
) -> None:
    params = _params(SMALL)
    minibatch = _minibatch(params, SMALL, 40)
    with jax.default_matmul_precision(precision):
        jaxpr = str(
            jax.make_jaxpr(lambda p, m: _gradient(p, m, SMALL, jnp.float32(1.0)))(params, minibatch)
        )
    # Actor and critic each compute two matrix products forward and three backward.
    assert jaxpr.count("dot_general[") == 10
    assert jaxpr.count("Precision.HIGHEST, Precision.HIGHEST") == (10 if of_all else 0)


# Wiring


def _batch(drawn: Batch, groups: int) -> Batch:
    names = ("observation", "action", "log_prob", "advantage", "return_", "valid")
    cut = {n: np.reshape(x := getattr(drawn, n), (groups, -1, *x.shape[1:])) for n in names}
    return Batch(**cut)


def _learn(
    config: AlgoConfig, begun: LearnerState, batch: Batch, backend: Backend = "fused"
) -> Any:
    """Returns the parameters, the optimiser's state and the metrics after one update."""
    update = jax.jit(lambda b: _ppo(config, backend).update(begun, b, jax.random.key(1)))
    made, metrics = update(batch)
    return made.params, made.optimizer_state, metrics


def _interpret(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Runs the kernels in interpret mode; returns a list that grows with each trace of them."""
    calls, real = [], fused.flat_gradient

    def counted(*arguments: Any, launch: Launch) -> Any:
        calls.append(arguments)
        return real(*arguments, launch=launch)

    learners.interpret_kernels(monkeypatch)
    monkeypatch.setattr(fused, "flat_gradient", counted)
    return calls


def _assert_learned_alike(found: Any, expected: Any) -> None:
    """Checks that two results of Adam agree, up to the rounding of their gradients."""
    chex.assert_trees_all_equal_structs(found, expected)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), found, expected
    )


@pytest.mark.slow
def test_a_learner_that_takes_all_at_once_learns_as_by_autodiff(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = replace(SMALL, num_minibatches=1, epochs=3)
    begun = jax.jit(_ppo(config).init)(jax.random.key(0))
    batch = _batch(_minibatch(begun.params, config, 8 * 20), 8)
    expected = _learn(config, begun, batch, "autodiff")
    calls = _interpret(monkeypatch)
    _assert_learned_alike(_learn(config, begun, batch), expected)
    assert len(calls) == 1  # traced once, inside a loop over the steps


@pytest.mark.slow
def test_a_learner_steps_through_the_tiles_that_it_has_shuffled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = replace(SMALL, num_minibatches=4, epochs=2)
    begun = jax.jit(_ppo(config).init)(jax.random.key(0))
    drawn = _minibatch(begun.params, config, 32 * 40)
    _interpret(monkeypatch)
    found = _learn(config, begun, _batch(drawn, 32))

    # Computes the same by hand: about 900 valid samples, normalised, in tiles of 64.
    valid = jax.tree.map(lambda x: x[np.asarray(drawn.valid)], drawn)
    mean, std = np.mean(valid.advantage), np.std(valid.advantage)
    valid = replace(valid, advantage=(valid.advantage - mean) / (std + 1e-8))
    count = len(valid.valid)
    # A new learner's moments are 0 and 1, which leave observations unchanged.
    keys = jax.random.split(jax.random.key(1), config.epochs)
    tiles = fused.shuffle(keys, 1280, jnp.int32(count), 4, fused.LAUNCH)
    progress, told = (begun.params, begun.optimizer_state), []
    for first, last in np.asarray(tiles.span):
        chosen = np.asarray(tiles.order)[first:last]
        rows = np.concatenate([np.arange(64 * i, min(64 * i + 64, count)) for i in chosen])
        part = jax.tree.map(lambda x, rows=rows: x[rows], valid)
        gradient = jax.grad(gradients.ppo_loss, has_aux=True)
        slope = gradient(progress[0], part, _nets(config), config, count / 4)
        learning = _ppo(config).learning
        progress, metrics = gradients.take(learning, progress, slope, jnp.bool_(True))
        told.append(metrics)
    means = jax.tree.map(lambda *x: np.mean(x), *told)
    del means["taken_steps"]
    means["std"] = np.mean(np.exp(progress[0]["actor"]["log_std"]))
    _assert_learned_alike(found, (*progress, means))


@pytest.mark.slow
def test_minibatches_without_a_valid_sample_are_no_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(SMALL, num_minibatches=4, epochs=3)
    begun = jax.jit(_ppo(config).init)(jax.random.key(0))
    drawn = _minibatch(begun.params, config, 8 * 40)
    _interpret(monkeypatch)
    few = replace(drawn, valid=drawn.valid & (np.arange(8 * 40) < 80))  # one tile of 64
    params, state, _ = _learn(config, begun, _batch(few, 8))
    counts = [int(leaf) for leaf in jax.tree.leaves(state) if leaf.ndim == 0]
    assert counts == [3] * len(counts)  # one step a pass
    after = replace(begun, params=params, optimizer_state=state)
    none = replace(drawn, valid=np.zeros(8 * 40, bool))
    still = _learn(config, after, _batch(none, 8))
    chex.assert_trees_all_equal((params, state), still[:2])


@pytest.mark.slow
def test_learners_side_by_side_learn_as_each_does_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(SMALL, num_minibatches=2, epochs=2)
    _interpret(monkeypatch)
    begun, batches = [], []
    for seed, share in enumerate((1.0, 0.4, 0.0)):
        begun.append(jax.jit(_ppo(config).init)(jax.random.key(seed)))
        drawn = _minibatch(begun[-1].params, config, 8 * 20, seed)
        batches.append(_batch(replace(drawn, valid=np.arange(8 * 20) < share * 8 * 20), 8))

    def update(learner: LearnerState, batch: Batch) -> LearnerState:
        return _ppo(config).update(learner, batch, jax.random.key(3))[0]

    stacked = jax.tree.map(lambda *x: jnp.stack(x), *zip(begun, batches, strict=True))
    together = jax.jit(jax.vmap(update))(*stacked)
    for lane, (one, batch) in enumerate(zip(begun, batches, strict=True)):
        mine = jax.tree.map(lambda x, i=lane: x[i], together)
        chex.assert_trees_all_close(mine, jax.jit(update)(one, batch), atol=1e-6)  # rounding


@hypothesis.settings(deadline=None, max_examples=50)
@hypothesis.given(
    samples=st.integers(1, 700), share=st.floats(0.0, 1.0), minibatches=st.integers(1, 9)
)
@pytest.mark.slow
def test_tiles_with_valid_samples_are_dealt_out_once_a_pass(
    samples: int, share: float, minibatches: int
) -> None:
    valid = int(share * samples)
    keys = jax.random.split(jax.random.key(samples), 3)
    tiles = fused.shuffle(keys, samples, jnp.int32(valid), minibatches, Launch(16, 4, 4))
    spans, used = np.asarray(tiles.span).reshape(3, minibatches, 2), -(-valid // 16)
    dealt = [[np.asarray(tiles.order)[a:b] for a, b in one_pass] for one_pass in spans]
    for one_pass in dealt:
        assert sorted(np.concatenate(one_pass).tolist()) == list(range(used))
        sizes = [len(part) for part in one_pass]
        assert max(sizes) - min(sizes) <= 1
    if used > 20:  # two random orders are equal with a chance below 1 / 20!
        assert np.any(np.concatenate(dealt[0]) != np.concatenate(dealt[1]))


def test_what_the_kernels_tell_are_the_metrics_of_the_loss() -> None:
    params = _params(SMALL)
    _, expected = _expected(params, _minibatch(params, SMALL, 8), SMALL, 8.0)
    of_the_step = (
        "grad_norm",
        "taken_steps",
        "skipped_steps",
    )  # metrics that `gradients.take` adds to the metrics of the loss
    assert sorted(expected) == [name for name in fused.METRICS if name not in of_the_step]


@pytest.mark.parametrize("name", ["actor", "critic"])
def test_a_layout_finds_each_parameter_in_the_vector(name: str) -> None:
    params = _params(AlgoConfig(hidden_sizes=(16, 32)))
    layout, flat = fused.layouts(params)[name], np.asarray(fused.flatten(params)[name])
    network = params[name]
    layers = [*network["torso"].values(), network["mean" if name == "actor" else "value"]]
    for place, layer in zip(layout.layers, layers, strict=True):
        kernel = flat[place.kernel :][: layer["kernel"].size].reshape(place.shape)
        np.testing.assert_array_equal(kernel, layer["kernel"])
        np.testing.assert_array_equal(flat[place.bias :][: place.shape[1]], layer["bias"])
    for key, (first, width) in layout.vectors.items():
        np.testing.assert_array_equal(flat[first:][:width], network[key])
    assert list(layout.vectors) == (["log_std"] if name == "actor" else [])
    assert layout.size == len(flat)


@pytest.mark.parametrize(
    ("hidden", "possible"),
    [
        ((64, 64), True),
        # 4 * (16 * 128 + 2 * 128 * 16 + 64 * (16 + 2 * 128)) = 94,208 of the chip's 97,280 bytes.
        ((128,), True),
        # 4 * (16 * 64 + 2 * (2 * 64 * 64 + 64 * 16) + 64 * (16 + 2 * 64)) = 114,688 bytes.
        ((64, 64, 64), False),
        ((16, 32, 16), True),
        ((48,), False),
        ((8,), False),
        ((64, 8), False),
        ((256,), False),
    ],
)
def test_layers_fit_by_their_widths_and_by_the_memory_on_the_chip(
    hidden: tuple[int, ...], possible: bool
) -> None:
    config = AlgoConfig(hidden_sizes=hidden)
    assert fused.fits(config, OBSERVATION, ACTION) is possible


def test_a_wide_observation_does_not_fit() -> None:
    assert fused.fits(SMALL, 128, ACTION)
    assert not fused.fits(SMALL, 129, ACTION)
    assert kernel.padded_width(129) == 256


def _on(monkeypatch: pytest.MonkeyPatch, **device: str) -> None:
    monkeypatch.setattr(fused.jax, "devices", lambda: [SimpleNamespace(**device)])


@pytest.mark.parametrize(
    ("capability", "hidden", "expected"),
    [
        # Tiles of 128 samples need
        # 4 B * (16 * 64 + 2 * (64 * 64 + 64 * 16) + 128 * (16 + 2 * 64)) = 116 KiB.
        ("9.0", (64, 64), fused.LARGE),
        ("8.0", (64, 64), fused.LARGE),
        ("8.9", (64, 64), fused.LAUNCH),
        ("8.9", (32, 32), fused.LARGE),
    ],
)
def test_tiles_are_as_large_as_the_chip_takes(
    capability: str, hidden: tuple[int, ...], expected: Launch, monkeypatch: pytest.MonkeyPatch
) -> None:
    _on(monkeypatch, compute_capability=capability)
    found = fused.choose_launch(AlgoConfig(hidden_sizes=hidden), OBSERVATION, ACTION)
    assert found == expected


@pytest.mark.parametrize(("samples", "expected"), [(8191, fused.LAUNCH), (8192, fused.LARGE)])
def test_a_small_batch_has_small_tiles(
    samples: int, expected: Launch, monkeypatch: pytest.MonkeyPatch
) -> None:
    _on(monkeypatch, compute_capability="9.0")
    config = AlgoConfig(num_minibatches=8)  # 8 minibatches of 8 tiles of 128 are 8,192 samples
    assert fused.choose_launch(config, OBSERVATION, ACTION, samples) == expected
