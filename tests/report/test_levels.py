"""Checks what a report shows of a curriculum over levels: figures over time, and pictures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swarmjax.config import ConfigError
from swarmjax.curriculum.config import CurriculumConfig, LevelsConfig
from swarmjax.curriculum.log import log
from swarmjax.report import figures, levels, rows
from swarmjax.report import page as report_page
from swarmjax.run import practised
from swarmjax.run.display import LevelsState, summarize
from swarmjax.task import level
from swarmjax.task import stage as task_stage
from swarmjax.training import practice
from tests.runs import CONFIG, row, write

LEVELS = LevelsConfig(mode="learnability", buffer=8)
TRAINED = replace(CONFIG, curriculum=CurriculumConfig(levels=LEVELS))
TOLD = {
    "levels_fresh": [3, 0],
    "levels_replayed": [5, 0],
    "levels_mutated": [2, 0],
    "levels_held": [4, 0],
    "levels_success": [0.5, None],
    "levels_score": [0.2, None],
    "levels_generation": [0.0, None],
}


def _run(tmp_path: Path, best: object = None) -> Path:
    run = write(tmp_path, [row(i, **TOLD) for i in range(4)], trained=TRAINED)
    if best is not None:
        (run / practised.FILE).write_text(json.dumps(best))
    return run


def _best(count: int) -> dict:
    numbers = np.random.default_rng(0).random((count, practice.number_count(TRAINED)))
    each = {"score": 0.2, "episodes": 4.0, "successes": 2.0, "generation": 1}
    return {"update": 4, "levels": [[[each | {"numbers": list(x)} for x in numbers], []]]}


def test_rows_are_read_by_stage(tmp_path: Path) -> None:
    history = rows.read(_run(tmp_path))
    assert history.levels is not None
    np.testing.assert_array_equal(history.levels["levels_held"][0, -1], [4.0, 0.0])
    np.testing.assert_array_equal(history.levels["levels_success"][0, -1], [0.5, np.nan])


def test_a_run_without_a_buffer_has_no_figure_of_levels(tmp_path: Path) -> None:
    history = rows.read(write(tmp_path, [row(i) for i in range(4)]))
    assert history.levels is None
    assert figures.levels(history) is None
    assert levels.read(tmp_path, history.config) is None


def test_the_figure_over_time_draws_what_was_measured(tmp_path: Path) -> None:
    figure = figures.levels(rows.read(_run(tmp_path)))
    assert figure is not None
    held, again, success, score = (figure.axes[i].lines[0].get_ydata() for i in range(4))
    np.testing.assert_allclose(np.asarray(held, float), 4.0)
    np.testing.assert_allclose(np.asarray(again, float), 7 / 10)
    np.testing.assert_allclose(np.asarray(success, float), 0.5)
    np.testing.assert_allclose(np.asarray(score, float), 0.2, rtol=1e-6)  # float32


def test_pictures_show_the_levels_with_the_best_scores(tmp_path: Path) -> None:
    run = _run(tmp_path, _best(2))
    best = levels.read(run, TRAINED)
    assert best is not None
    figure = levels.draw(best, TRAINED)
    assert figure is not None
    titles = [axis.get_title() for axis in figure.axes]
    told = "pair\n50 % of 4, score 0.2, mutation 1"
    assert titles == [told, told, ""]  # no level of the other stage is kept
    # The patches are the wall, and a disc and a circle for each of two robots.
    assert len(figure.axes[0].patches) == 1 + 2 * 2
    centre = figure.axes[0].patches[1].get_center()  # pyright: ignore[reportAttributeAccessIssue]
    arrays = task_stage.single(TRAINED.stage[0])
    drawn = level.sample(best[0][0]["numbers"], arrays, practice.spacing(TRAINED), np)
    np.testing.assert_allclose(centre, drawn.start[0, :2])


@pytest.mark.parametrize(
    "best",
    [{}, {"levels": [[]]}, {"levels": [[[{"numbers": "x"}], []]]}, {"levels": 3}],
    ids=["nothing", "too few stages", "no numbers", "no lists"],
)
def test_a_damaged_file_is_refused(best: dict, tmp_path: Path) -> None:
    run = _run(tmp_path, best)
    with pytest.raises(ConfigError, match="holds no levels of 2 stages: it is damaged"):
        levels.read(run, TRAINED)


def test_the_best_of_a_checkpoint_are_written_down() -> None:
    score = np.array([[[0.1, 0.3, 0.2, 0.25, -1.0], [-1.0] * 5]])
    shape = score.shape
    leaves = {
        "update": np.array([7]),
        "curriculum/levels/score": score,
        "curriculum/levels/episodes": (score > 0).astype(float),
        "curriculum/levels/successes": np.zeros(shape),
        "curriculum/levels/generation": np.zeros(shape, int),
        "curriculum/levels/numbers": np.arange(10.0).reshape(1, 2, 5, 1),
    }
    found = practised.best(leaves)
    assert found is not None
    assert found["update"] == 7
    assert [each["numbers"] for each in found["levels"][0][0]] == [[1.0], [3.0], [2.0]]
    assert found["levels"][0][1] == []
    assert practised.best({"update": np.array([7])}) is None


def test_the_decision_log_says_what_was_practised() -> None:
    given = row(3, decision=4, estimate_by_stage=[0.5, 0.5], **TOLD)
    (entry,) = log([given], ["pair", "trio"], 0)
    assert entry["levels"]["pair"] == {"held": 4, "success": 0.5, "score": 0.2}
    assert "levels" not in log([row(3, decision=4, estimate_by_stage=[0, 0])], ["a", "b"], 0)[0]


def test_the_live_table_says_how_the_levels_go() -> None:
    given = {
        "stage": "pair",
        "episodes": 1,
        "reached": 1,
        "targets": 2,
        "reward": 0.0,
        "contacts": 0,
        "value_loss": 0.0,
        "policy_loss": 0.0,
    }
    summary = summarize([row(3, **given, **TOLD)], ["pair", "trio"])
    assert summary["stages"][0].levels == LevelsState(held=4.0, success=0.5, again=0.7)
    assert summary["stages"][1].levels == LevelsState(held=0.0, success=None, again=None)
    plain = summarize([row(3, **given)], ["pair", "trio"])
    assert plain["stages"][0].levels is None


def test_the_page_tells_the_options(tmp_path: Path) -> None:
    facts = dict(report_page.facts(rows.read(_run(tmp_path))))
    assert "levels.mode=learnability, levels.buffer=8, levels.replay=0.5" in facts["curriculum"]
