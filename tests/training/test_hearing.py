"""Checks training of robots that hear: resumed runs bit for bit, and the policy file."""

from pathlib import Path

import numpy as np
import pytest

from swarmjax import policy, policy_file, train
from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import digest

WORDS = [
    "stage=s3",
    "arenas=4",
    "budget=192",
    "algo.rollout_length=8",
    "algo.num_minibatches=2",
    "algo.hidden_sizes=[8]",
    "task.step_limit=12",
    "task.neighbours.count=2",
    "run.tensorboard=false",
]
KINDS = {
    "plain": [],
    "both": [
        "algo.memory=gru",
        "algo.memory_size=4",
        "algo.critic=state",
        "realism.packet_loss=0.3",
    ],
}


def _run(path: Path, *words: str) -> None:
    assert train.main([*WORDS, f"run.dir={path}", *words]) == 0


@pytest.mark.parametrize("kind", ["plain", "both"])
@pytest.mark.slow
def test_a_resumed_run_is_bit_for_bit_that_of_one_go(kind: str, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    _run(whole, *KINDS[kind])
    _run(parts, *KINDS[kind], "run.stop_after=3")
    assert train.main([f"resume={parts}"]) == 0
    assert digest(checkpoint.find(whole)[0]) == digest(checkpoint.find(parts)[0])
    trained = policy_file.read(whole / "policy.npz")
    assert trained.meta["format"] == policy.FORMAT
    assert trained.neighbours == {"count": 2, "range": 0.7}
    np.testing.assert_array_equal(trained.mean[0, 10:], 0.0)
    np.testing.assert_array_equal(trained.std[0, 10:], 1.0)
    assert policy.load(whole / "policy.npz").digest == trained.digest
