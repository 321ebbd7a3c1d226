"""Tests the preset's whole training loop at a smaller scale, with two seeds side by side."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from swarmjax import policy
from swarmjax.run.checkpoint import to_leaves
from swarmjax.run.load_settings import load_train
from swarmjax.run.policy_export import write_policy
from swarmjax.run.settings import TrainConfig
from swarmjax.task.observation import SIZE
from swarmjax.training import loop, mesh, seeds
from swarmjax.training import program as programs

ROLLOUT, LIMIT, UPDATES = 128, 32, 8
KERNEL = "learners/params/actor/mean/kernel"


@pytest.fixture(scope="module")
def config() -> TrainConfig:
    paper = load_train(["algo=paper", "sim.impl=jax"])
    return replace(
        paper,
        stage=paper.stage[1:3],  # two robots, then three and the fence
        sim=replace(paper.sim, max_robots=3, max_obstacles=1),
        algo=replace(
            paper.algo, hidden_sizes=(8,), rollout_length=ROLLOUT, epochs=3, std_interval=250
        ),
        # No robot arrives within so few steps, so promotion happens at the deadline.
        task=replace(paper.task, step_limit=LIMIT),
        curriculum=replace(paper.curriculum, exploration="reset"),
        budget=ROLLOUT * UPDATES,
        seeds=2,
    )


@pytest.mark.slow
def test_it_trains_and_judges_in_one_trace(config: TrainConfig) -> None:
    program, schedule = programs.load(config)
    traces = []

    def chunk(state: loop.TrainState, n: np.int32) -> tuple[loop.TrainState, dict]:
        traces.append(None)
        return seeds.chunk(program)(schedule, state, n)

    start = jax.jit(mesh.init(program))(schedule)
    run = jax.jit(chunk)
    early, first = run(start, np.int32(3))
    state, rest = run(early, np.int32(5))
    found = {
        name: np.concatenate([first[name][:, :3], rest[name][:, :5]], axis=1) for name in first
    }
    assert len(traces) == 1
    # A rollout of 128 steps holds four episodes of 32 steps. The first episode that ends after the
    # promotion began before it, on the previous stage, so only three count in this update.
    assert found["episodes"].tolist() == [[4, 4, 4, 4, 3, 4, 4, 4]] * 2
    # Every episode counts. Episodes that begin in the same update are judged together, one update
    # later. The episode with which the run begins is judged with those of the first update.
    assert found["episodes_by_stage"][:, 1:4, 0].tolist() == [[5, 4, 4]] * 2
    # The first of the two stages gets half of the eight updates.
    assert found["stage"].tolist() == [[0] * 4 + [1] * 4] * 2
    # Each level of the deviation lasts 250 steps, and the updates end with steps 127, 255, 383 and
    # 511. The promotion then restarts the schedule, because of `exploration="reset"`. The tolerance
    # is for logarithms in float32.
    std = [0.6, 0.55, 0.55, 0.5] * 2
    np.testing.assert_allclose(found["std"], [std] * 2, rtol=1e-6)
    for name in ("policy_loss", "value_loss", "grad_norm"):
        assert np.isfinite(found[name]).all()
    before, middle, after = (to_leaves(each)[KERNEL] for each in (start, early, state))
    # At first only two of three robots are present, so the learner of the third does not change.
    assert (np.abs(middle - before).max(axis=(2, 3)) > 1e-5).tolist() == [[True, True, False]] * 2
    assert (np.abs(after - middle).max(axis=(2, 3)) > 1e-5).all()
    assert not np.array_equal(after[0], after[1])  # the seeds differ
    # The preset uses no normaliser, so its count stays zero.
    assert not to_leaves(state)["learners/normalizer/count"].any()
    assert to_leaves(state)["learners/explored"].tolist() == [[512] * 3] * 2


def test_an_exported_policy_has_the_output_of_tanh(config: TrainConfig, tmp_path: Path) -> None:
    program, schedule = programs.load(config)
    state = jax.jit(mesh.init(program))(schedule)
    # The last layer is drawn small; ten times larger, it reaches the nonlinear range of tanh.
    actor = state.learners.params["actor"]
    actor = {**actor, "mean": jax.tree.map(lambda x: 10.0 * x, actor["mean"])}
    learners = state.learners.replace(params={**state.learners.params, "actor": actor})
    state = state.replace(learners=learners)
    leaves = {name: np.asarray(leaf) for name, leaf in to_leaves(state).items()}
    write_policy(tmp_path / "p.npz", leaves, config, update=0, seed=1)
    observation = np.random.default_rng(0).uniform(0.0, 1.0, (5, 3, SIZE)).astype(np.float32)
    found = policy.act(policy.load(tmp_path / "p.npz"), observation)
    second = jax.tree.map(lambda x: x[1], learners)
    noise = np.zeros((3, 5, 2), np.float32)
    expected, _, _ = jax.vmap(program.ppo.act)(second, observation.swapaxes(0, 1), noise)
    expected = expected.swapaxes(0, 1)
    # Two libraries compute this in float32.
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(expected).max() > 0.5
