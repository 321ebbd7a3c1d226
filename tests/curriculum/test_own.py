"""Checks a user's own curriculum: the one that docs/extending.md shows."""

import re
from functools import partial
from pathlib import Path

import extensions
import jax
import jax.numpy as jnp
import numpy as np
from sentences import refusal

from swarmjax import extension
from swarmjax.curriculum import engine, stages
from swarmjax.curriculum.engine import REWEIGHED, Curriculum, Schedule
from swarmjax.run.load_settings import load_train
from swarmjax.task.episode import Ended
from swarmjax.training import program as programs

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"


def _load(path: Path, body: str, name: str) -> tuple[Curriculum, Schedule]:
    words = [f"extensions={extensions.write(path, body)}", f"curriculum.mode={name}"]
    config = load_train(["stage=curriculum", *words])
    assert list(config.pieces["curriculum"]) == [name]
    schedule = programs.schedule(config)
    own = extension.load(config.extensions).curricula
    return stages.make(schedule, config.curriculum, own), schedule


def test_the_curriculum_of_the_guide(tmp_path: Path) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    body = next(block for block in blocks if "@curriculum" in block)
    assert body.count("\n") - body.count("\n\n") <= 30
    own, schedule = _load(tmp_path / "own.py", body, "weakest")
    schedule = schedule._replace(cohort_updates=jnp.int32(1))
    state, key = engine.init(own, schedule), jax.random.key(0)
    assert set(own.choose(state.own, key, (4, 64)).ravel().tolist()) == set(range(6))
    observe = jax.jit(partial(engine.observe, own, schedule, "targets"))
    one, stage = jnp.ones((1, 6), jnp.int32), jnp.arange(6)[None]
    reached = 1 * (stage != 2)  # the third stage reaches nothing
    for update in range(2):
        ended = Ended(
            episodes=one,
            stage=stage,
            cohort=update * one,
            targets=one,
            reached=reached,
            all_reached=reached,
            steps=one,
            robot_steps=one,
            sensed=one,
            contacts=jnp.zeros((1, 6, 3), jnp.int32),
            reward=1.0 * one,
            broken=0 * one,
        )
        state = observe(state, ended, jnp.int32(update))
        assert int(state.chosen.reason) == REWEIGHED
    expected = [1 / 12, 1 / 12, 7 / 12, 1 / 12, 1 / 12, 1 / 12]
    np.testing.assert_allclose(state.chosen.weights, expected, rtol=1e-6)  # float32


def test_what_a_curriculum_raises_is_one_sentence(tmp_path: Path) -> None:
    body = "@curriculum\ndef mine(schedule):\n    return 1 / 0\n"
    sentence = refusal(_load, tmp_path / "mine.py", body, "mine")
    assert sentence.endswith("curriculum mine fails: ZeroDivisionError: division by zero.")
