"""Tests when a run saves."""

import time

from swarmjax.run.run import Run
from swarmjax.run.settings import TrainConfig


def test_a_checkpoint_is_due_after_a_tenth_of_the_budget(tiny_config: TrainConfig) -> None:
    run = Run(tiny_config)
    assert tiny_config.updates == 20
    run._saved = (time.monotonic(), 5)  # the newest checkpoint: now, after 5 updates
    run.update = 6
    assert not run._is_checkpoint_due()
    run.update = 7
    assert run._is_checkpoint_due()
