"""Checks what a promotion changes in the learners, leaf by leaf."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import learners
import numpy as np
import optax
import pytest

from swarmjax.curriculum import engine, stages
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import LearnerState
from swarmjax.run.settings import TrainConfig
from swarmjax.shards import ALONE
from swarmjax.training import loop
from swarmjax.training import program as programs
from swarmjax.training.rollout import Program

LEARNERS, OBSERVED = 5, 3
ALGO = AlgoConfig(
    hidden_sizes=(4,),
    policy="independent",
    epochs=2,
    num_minibatches=1,
    initial_std=0.5,
    rollout_length=8,
)


@pytest.fixture(scope="module")
def config(tiny_config: TrainConfig) -> TrainConfig:
    return replace(tiny_config, algo=ALGO, sim=replace(tiny_config.sim, max_robots=LEARNERS))


@pytest.fixture(scope="module")
def trained(config: TrainConfig) -> LearnerState:
    """Returns five learners after one update, each from its own batch."""
    keys = jax.random.split(jax.random.key(0), LEARNERS)
    made = learners.ppo(ALGO, Sizes(OBSERVED, 2), config.updates, "autodiff")
    start = jax.vmap(made.init)(keys)
    draw = iter(jax.random.split(jax.random.key(1), 6))

    def numbers(*shape: int) -> jax.Array:
        return jax.random.normal(next(draw), (LEARNERS, 4, 8, *shape))

    batch = Batch(
        observation=numbers(OBSERVED),
        action=numbers(2),
        log_prob=numbers(),
        advantage=numbers(),
        return_=numbers(),
        valid=jnp.ones((LEARNERS, 4, 8), bool),
    )
    learn = jax.jit(jax.vmap(made.update))
    return learn(start, batch, keys)[0]


def _promote(
    trained: LearnerState,
    config: TrainConfig,
    before: int = 2,
    after: int = 2,
    promoted: bool = True,
    **options: Any,
) -> LearnerState:
    chosen = replace(config, curriculum=CurriculumConfig(mode="sequential", **options))
    nowhere: Any = None  # nothing is simulated
    program = Program(
        chosen, nowhere, learners.ppo(chosen.algo, Sizes(OBSERVED, 2)), nowhere, ALONE
    )
    schedule = programs.schedule(chosen)
    state = engine.init(stages.make(schedule, chosen.curriculum), schedule)
    reason = jnp.int32(engine.BY_THRESHOLD if promoted else engine.STAYED)
    now = replace(state.own, chosen=state.chosen._replace(reason=reason))
    met = jnp.int32(before), jnp.int32(after)
    return loop.carry_over(
        trained, program, replace(state, met=met[0]), replace(state, own=now, met=met[1])
    )


def _assert_same(found: Any, expected: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, found, expected)


RESET = {"optimizer": "reset", "exploration": "reset"}


@pytest.mark.slow
def test_newcomers_take_over_in_turn(config: TrainConfig, trained: LearnerState) -> None:
    found = _promote(trained, config, before=2, after=5)
    # Robots 0 and 1 have trained. Robots 2, 3 and 4 copy the parameters, the optimiser and the
    # normaliser of robots 0, 1 and 0.
    _assert_same(found, jax.tree.map(lambda x: x[np.array([0, 1, 0, 1, 0])], trained))
    kernel = np.asarray(found.params["actor"]["mean"]["kernel"])
    assert not np.array_equal(kernel[0], kernel[1])


def test_only_those_come_that_the_swarm_grows_by(
    config: TrainConfig, trained: LearnerState
) -> None:
    found = _promote(trained, config, before=3, after=4)
    _assert_same(found, jax.tree.map(lambda x: x[np.array([0, 1, 2, 0, 4])], trained))
    _assert_same(_promote(trained, config, before=3, after=3), trained)


def test_what_is_kept_costs_nothing(config: TrainConfig, trained: LearnerState) -> None:
    shared = replace(config, algo=replace(ALGO, policy="shared"))
    one = jax.tree.map(lambda x: x[:1], trained)
    assert _promote(one, shared, before=2, after=5) is one


def test_nothing_happens_without_a_promotion(config: TrainConfig, trained: LearnerState) -> None:
    found = _promote(trained, config, before=2, after=5, promoted=False, **RESET)
    _assert_same(found, trained)


def test_optimizer(config: TrainConfig, trained: LearnerState) -> None:
    found = _promote(trained, config, optimizer="reset")
    _assert_same((found.params, found.normalizer), (trained.params, trained.normalizer))

    def parts(state: Any, kind: type) -> list[Any]:
        leaves = jax.tree.leaves(state, is_leaf=lambda part: isinstance(part, kind))
        return [part for part in leaves if isinstance(part, kind)]

    adams = parts(found.optimizer_state, optax.ScaleByAdamState)
    assert len(adams) == 2  # of actor and critic
    for before, after in zip(
        parts(trained.optimizer_state, optax.ScaleByAdamState), adams, strict=True
    ):
        assert all(np.any(leaf) for leaf in jax.tree.leaves(before))
        assert not any(np.any(leaf) for leaf in jax.tree.leaves(after))
    rates = parts(found.optimizer_state, optax.ScaleByScheduleState)
    assert [rate.count.tolist() for rate in rates] == [[2] * LEARNERS] * 2  # gradient steps so far


def test_exploration(config: TrainConfig, trained: LearnerState) -> None:
    before = trained.params["actor"]["log_std"]
    assert np.abs(np.exp(before) - 0.5).max() > 1e-4  # it has moved
    found = _promote(trained, config, exploration="reset")
    # 0.5 is the config's initial_std, up to float32 rounding.
    np.testing.assert_allclose(np.exp(found.params["actor"]["log_std"]), 0.5, rtol=1e-6)
    kept = found.params["actor"] | {"log_std": before}
    _assert_same(replace(found, params=found.params | {"actor": kept}), trained)


def test_newcomers_are_reset_like_the_others(config: TrainConfig, trained: LearnerState) -> None:
    found = _promote(trained, config, before=2, after=4, **RESET)
    kernel = np.asarray(trained.params["critic"]["torso"]["hidden_0"]["kernel"])
    _assert_same(
        found.params["critic"]["torso"]["hidden_0"]["kernel"], kernel[np.array([0, 1, 0, 1, 4])]
    )
    np.testing.assert_allclose(np.exp(found.params["actor"]["log_std"]), 0.5, rtol=1e-6)  # float32
