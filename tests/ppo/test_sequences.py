"""Checks that policies with memory learn the same from the useful sequences as from all."""

from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.ppo import gradients, ppo
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.dispatch import Backend
from swarmjax.ppo.fast import sequences
from swarmjax.ppo.gradients import Metrics
from swarmjax.ppo.memory import Recall
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO, LearnerState
from swarmjax.shards import Shards

GROUPS, ROBOTS, STEPS, SIZE, UPDATES = 4, 5, 8, 3, 10
OBSERVATION, ACTION = 6, 2
CONFIG = AlgoConfig(
    memory="gru",
    memory_size=SIZE,
    hidden_sizes=(4,),
    num_minibatches=1,
    epochs=1,
    rollout_length=STEPS,
    entropy_cost=0.01,
    max_grad_norm=None,  # clipping would give even a wrong gradient the right norm
)
# Of 5 robots, two have all steps, one has only the first four, and two are absent.
ENDS = np.array([STEPS, STEPS, 4, 0, 0])


@pytest.fixture(autouse=True)
def _small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequences, "CPU_TILE", 5)  # 12 sequences: two tiles and part of a third


def _batch(seed: int = 0, ends: np.ndarray = ENDS) -> Batch:
    rng = np.random.default_rng(seed)
    shape = (GROUPS, STEPS, ROBOTS)

    def drawn(*more: int) -> jax.Array:
        return jnp.array(rng.normal(size=(GROUPS, STEPS * ROBOTS, *more)), jnp.float32)

    valid = np.broadcast_to(np.arange(STEPS)[:, None] < ends, shape)
    begins = np.zeros(shape, bool)
    begins[1, 5] = begins[2, 2, 1] = True  # an arena and one robot begin an episode
    return Batch(
        observation=drawn(OBSERVATION),
        action=drawn(ACTION),
        log_prob=jnp.full((GROUPS, STEPS * ROBOTS), -2.5),
        advantage=drawn(),
        return_=drawn(),
        valid=jnp.array(valid.reshape(GROUPS, -1)),
        memory=Recall(*jnp.array(rng.normal(size=(2, GROUPS, ROBOTS, SIZE)), jnp.float32)),
        begins=jnp.array(begins.reshape(GROUPS, -1)),
    )


def _ppo(config: AlgoConfig, backend: Backend = "sequences") -> PPO:
    return learners.ppo(config, Sizes(OBSERVATION, ACTION), UPDATES, backend)


def _learner(seed: int = 0) -> LearnerState:
    return jax.jit(_ppo(CONFIG).init)(jax.random.key(seed))


@partial(jax.jit, static_argnums=(2, 3))
def _update(
    learner: LearnerState, batch: Batch, config: AlgoConfig, backend: Backend = "sequences"
) -> tuple[LearnerState, Metrics]:
    return _ppo(config, backend).update(learner, batch, jax.random.key(1))


def _samples(batch: Batch) -> Batch:
    return ppo._samples(_learner(), CONFIG, batch, ppo.ALONE)


@pytest.mark.parametrize("minibatches", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_gradients_of_minibatches_add_up_to_that_of_all_samples(minibatches: int) -> None:
    samples, params = _samples(_batch()), _learner().params
    count = jnp.sum(samples.valid)
    rows = jax.jit(sequences.arrange, static_argnums=1)(samples, STEPS)
    deal = jax.jit(sequences.deal, static_argnums=2)
    order, spans = deal(jax.random.key(3), rows.valid.any(axis=1), minibatches)
    learning = _ppo(replace(CONFIG, num_minibatches=minibatches)).learning
    gradient = jax.jit(lambda span: sequences.gradient(params, rows, order, span, learning, count))
    parts = [gradient(span) for span in spans]
    found = jax.tree.map(lambda *x: sum(x), *parts)
    whole = ppo._gather(samples, jnp.arange(GROUPS), CONFIG)
    loss = jax.grad(gradients.ppo_loss, has_aux=True)
    expected = jax.jit(loss, static_argnums=(2, 3))(params, whole, learning.networks, CONFIG, count)
    # Sums of 80 float32 terms of order 1 to 100, added in another order.
    chex.assert_trees_all_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_learner_learns_as_by_autodiff() -> None:
    found, expected = (
        _update(_learner(), _batch(), CONFIG, name) for name in ("sequences", "autodiff")
    )
    chex.assert_trees_all_equal_structs(found, expected)
    # Adam's first step is 1e-3 long. Rounding of the gradients changes it by at most a hundredth.
    chex.assert_trees_all_close(found, expected, rtol=1e-4, atol=1e-5)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), found[0].params, _learner().params)
    assert min(jax.tree.leaves(moved)) > 1e-4


@pytest.mark.parametrize(("minibatches", "streams"), [(1, 1), (2, 1), (3, 1), (16, 1), (2, 4)])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_every_useful_sequence_is_dealt_once(minibatches: int, streams: int, share: float) -> None:
    useful = np.random.default_rng(0).uniform(size=48) < share
    shards = Shards(streams=streams)
    order, span = sequences.deal(jax.random.key(0), jnp.array(useful), minibatches, shards)
    dealt = [np.asarray(order)[first:end] for first, end in np.asarray(span)]
    np.testing.assert_array_equal(np.sort(np.concatenate(dealt)), np.flatnonzero(useful))
    np.testing.assert_array_equal(np.sort(order), np.arange(48))
    for stream in range(streams):
        mine = [np.sum(each // (48 // streams) == stream) for each in dealt]
        assert max(mine) - min(mine) <= 1


def test_sequences_are_dealt_anew_with_another_key() -> None:
    useful = jnp.ones(48, bool)
    first, second = (
        set(np.asarray(sequences.deal(jax.random.key(seed), useful, 2)[0][:24])) for seed in (0, 1)
    )
    # Two random halves of 48 sequences share at most 2 or at least 22 with a probability below
    # 1e-8.
    assert 2 < len(first & second) < 22


def test_a_minibatch_goes_through_its_sequences_and_no_others() -> None:
    """Marks each sequence by its memory, and each sample by its return."""
    batch = _batch()
    name = jnp.arange(GROUPS * ROBOTS, dtype=jnp.float32).reshape(GROUPS, 1, ROBOTS)
    step = jnp.arange(STEPS, dtype=jnp.float32)[:, None]
    memory = jnp.broadcast_to(name[:, 0, :, None], (GROUPS, ROBOTS, SIZE))
    batch = replace(
        batch,
        return_=(100 * step + name).reshape(GROUPS, -1),
        valid=jnp.ones_like(batch.valid),
        memory=Recall(memory, memory),
    )
    rows = sequences.arrange(_samples(batch), STEPS)
    order = jnp.array([7, 3, 19, 0, *[1] * 16])
    tile = sequences.take_tile(rows, order, jnp.int32(1), jnp.int32(3), 4)
    taken = np.array([3, 19, 0, 1])
    assert tile.memory is not None
    np.testing.assert_array_equal(tile.memory.actor[:, 0], taken)
    np.testing.assert_array_equal(
        tile.return_.reshape(STEPS, 4), 100 * np.arange(STEPS)[:, None] + taken
    )
    np.testing.assert_array_equal(tile.valid.reshape(STEPS, 4), [[True, True, False, False]] * 8)


@pytest.mark.parametrize("useful", [0, 1, 5, 40])
def test_tiles_follow_useful_sequences_and_not_robots(useful: int) -> None:
    for robots in (40, 400):
        marked = jnp.arange(robots) < useful
        _, span = sequences.deal(jax.random.key(0), marked, 1)
        assert span.tolist() == [[0, useful]]
        assert sequences.tile_size(robots, 1, STEPS, learners=1) == 5


def test_a_tile_holds_no_more_than_the_fullest_minibatch() -> None:
    assert sequences.tile_size(sequences=12, minibatches=4, steps=STEPS, learners=1) == 3


def test_absent_robots_may_hold_nan() -> None:
    batch = _batch()
    absent = jnp.tile(ENDS == 0, STEPS)

    def spoil(x: jax.Array) -> jax.Array:
        return jnp.where(absent.reshape(-1, *[1] * (x.ndim - 2)), jnp.nan, x)

    spoilt = replace(
        batch,
        observation=spoil(batch.observation),
        action=spoil(batch.action),
        log_prob=spoil(batch.log_prob),
        advantage=spoil(batch.advantage),
        return_=spoil(batch.return_),
        memory=jax.tree.map(lambda x: x.at[:, ENDS == 0].set(jnp.nan), batch.memory),
    )
    found, expected = (_update(_learner(), each, CONFIG) for each in (spoilt, batch))
    assert float(found[1]["skipped_steps"]) == 0.0
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_a_batch_of_nothing_valid_is_no_step() -> None:
    begun = _learner()
    after, metrics = _update(begun, _batch(ends=np.zeros(ROBOTS, int)), CONFIG)
    jax.tree.map(np.testing.assert_array_equal, after.params, begun.params)
    jax.tree.map(np.testing.assert_array_equal, after.optimizer_state, begun.optimizer_state)
    assert float(metrics["skipped_steps"]) == 0.0
    assert float(metrics["grad_norm"]) == 0.0


@pytest.mark.slow
def test_a_minibatch_without_a_sequence_is_no_step() -> None:
    config = replace(CONFIG, num_minibatches=4, epochs=3)
    batch = _batch()
    alone = jnp.zeros_like(batch.valid).at[2, ROBOTS].set(True)  # one step of robot 0 of an arena
    after, metrics = _update(_learner(), replace(batch, valid=alone), config)
    counts = [
        x for x in jax.tree.leaves(after.optimizer_state) if jnp.issubdtype(x.dtype, jnp.integer)
    ]
    assert counts
    assert all(int(x) == 3 for x in counts)  # one step an epoch
    assert float(metrics["grad_norm"]) > 0.0


@pytest.mark.slow
def test_learners_side_by_side_come_to_what_each_does_alone() -> None:
    config = replace(CONFIG, num_minibatches=2, epochs=2)
    ends = (ENDS, np.array([3, 0, 0, 0, 0]))  # the second learner has fewer tiles
    batches = [_batch(i, each) for i, each in enumerate(ends)]
    learners = [_learner(i) for i in range(2)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *zip(learners, batches, strict=True))
    together = jax.vmap(lambda learner, batch: _update(learner, batch, config))(*stacked)
    for i, (learner, batch) in enumerate(zip(learners, batches, strict=True)):
        alone = _update(learner, batch, config)
        mine = jax.tree.map(lambda x, i=i: x[i], together)
        # Batched matrix products round differently, over four steps of Adam of up to 1e-3 each.
        chex.assert_trees_all_close(mine, alone, rtol=1e-4, atol=1e-5)


# Stage s6 with 65,536 arenas, worlds with 4,096 arenas in 32 minibatches, one arena, and a million
# sequences.
@pytest.mark.parametrize(
    ("sequences_", "minibatches", "steps", "expected"),
    [(327_680, 8, 32, 10_240), (81_920, 32, 64, 1280), (5, 1, 32, 5), (10**6, 1, 32, 62_500)],
)
def test_an_accelerator_takes_a_minibatch_in_four_tiles_if_they_are_large(
    monkeypatch: pytest.MonkeyPatch, sequences_: int, minibatches: int, steps: int, expected: int
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert sequences.tile_size(sequences_, minibatches, steps, learners=1) == expected


# A full minibatch of 1,280 sequences has one tile, then four. 2 million samples of 1,000 learners
# are 32 sequences of each.
@pytest.mark.parametrize(("learners", "expected"), [(1, 1280), (10, 320), (1000, 32)])
def test_learners_side_by_side_share_the_samples_of_a_tile(
    monkeypatch: pytest.MonkeyPatch, learners: int, expected: int
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert sequences.tile_size(40_960, 32, 64, learners) == expected


def test_a_tile_of_many_learners_fills_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert sequences.tile_size(1024, 32, 64, learners=1000) == 16
