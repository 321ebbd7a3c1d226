"""Tests the training settings of a reproduction's arms."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from sentences import refusal

from swarmjax.config import build, to_dict
from swarmjax.reproduce import arms as reproduce_arms
from swarmjax.reproduce.config import ARMS, ReproduceConfig
from swarmjax.reproduce.rows import summaries
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig

OUT = Path("somewhere") / "a=b, c"
MADE = {arm: reproduce_arms.settings(ReproduceConfig(), arm, OUT) for arm in ARMS}
PAPER = load_train(["algo=paper"])


def test_the_paper_arms_are_the_preset() -> None:
    given = {"run": PAPER.run, "seeds": 1, "seeds_by": "vmap"}
    assert replace(MADE["curriculum"], **given) == PAPER
    baseline = load_train(["algo=paper", "stage=paper6"])
    assert replace(MADE["baseline"], **given) == baseline
    assert MADE["baseline"].seeds == 10
    for arm in ("curriculum", "baseline"):
        fine = MADE[f"{arm}_expanded"]
        assert fine.init_from == str(OUT / arm)
        assert (fine.stage_name, fine.budget, fine.algo) == ("paper_expanded", 250_000, PAPER.algo)


def test_the_modern_arms_differ_in_the_trainer_alone() -> None:
    default = load_train([])
    for arm in ("curriculum", "baseline"):
        modern, paper = MADE[f"modern_{arm}"], MADE[arm]
        for name in ("stage", "robot", "realism", "task", "sim", "budget", "seeds"):
            assert getattr(modern, name) == getattr(paper, name), name
        assert replace(modern.algo, rollout_length=default.algo.rollout_length) == default.algo
        assert modern.curriculum == default.curriculum
        assert modern.updates == 1_000_000 // (16 * 32)


def test_each_arm_has_its_directory_and_its_log() -> None:
    for arm, made in MADE.items():
        assert made.run.dir == str(OUT / arm)
        assert made.run.episodes


def test_a_directory_of_another_config_is_refused(tmp_path: Path) -> None:
    made = reproduce_arms.settings(ReproduceConfig(), "baseline", tmp_path)
    run = tmp_path / "baseline"
    run.mkdir()
    other = to_dict(replace(made, seeds=5))
    (run / "config.json").write_text(json.dumps(other))
    sentence = refusal(reproduce_arms.settings, ReproduceConfig(), "baseline", tmp_path)
    assert f"{run} holds a run with other settings: seeds is 10, not 5;" in sentence


def test_an_arm_that_was_stopped_goes_on(tmp_path: Path) -> None:
    made = reproduce_arms.settings(ReproduceConfig(), "baseline", tmp_path)
    (tmp_path / "baseline").mkdir()
    stored = to_dict(replace(made, run=replace(made.run, id="first")))
    (tmp_path / "baseline" / "config.json").write_text(json.dumps(stored))
    again = reproduce_arms.settings(ReproduceConfig(), "baseline", tmp_path)
    assert (again.resume, again.run.id) == (str(tmp_path / "baseline"), "first")


@pytest.mark.parametrize(
    ("spent", "stopped_at", "done"),
    [(True, None, True), (False, 0.9, True), (False, None, False)],
)
def test_an_arm_is_done_when_its_run_has_ended(
    spent: bool, stopped_at: float | None, done: bool, tmp_path: Path
) -> None:
    (tmp_path / "baseline").mkdir()
    summary = {"budget_spent": spent, "stopped_at": stopped_at}
    (tmp_path / "baseline" / "summary.json").write_text(json.dumps(summary))
    assert list(summaries(tmp_path)) == (["baseline"] if done else [])


def test_the_config_is_one_that_is_stored() -> None:
    for made in MADE.values():
        assert build(TrainConfig, to_dict(made)) == made
