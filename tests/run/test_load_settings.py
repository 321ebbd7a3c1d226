"""Tests how the settings of stored runs are read, and what a resumed run may change."""

import dataclasses
import json

import pytest
from sentences import refusal

from swarmjax.config import build, to_dict
from swarmjax.run.load_settings import load_resume, load_train
from swarmjax.run.settings import RunConfig, TrainConfig


def test_resume_changes_budget_and_run_only():
    stored = to_dict(load_train(["seed=7", "run.dir=old", "run.stop_after=3", "run.chunk=2"]))
    before = json.dumps(stored)
    resumed = load_resume(stored, ["budget=8e6", "resume=old", "run.tensorboard=false"])
    assert (resumed.seed, resumed.budget, resumed.resume) == (7, 8_000_000, "old")
    assert resumed.run == RunConfig(dir="old", chunk=2, tensorboard=False)
    assert json.dumps(stored) == before
    changed = {"budget": resumed.budget, "resume": "old", "run": resumed.run}
    assert resumed == dataclasses.replace(build(TrainConfig, stored), **changed)


def test_resume_may_stop_again():
    stored = to_dict(load_train(["run.stop_after=3"]))
    assert load_resume(stored, []).run.stop_after is None
    assert load_resume(stored, ["run.stop_after=5"]).run.stop_after == 5


def test_a_run_of_an_older_version_says_what_reads_it():
    stored = to_dict(load_train([]))
    stored["task"]["reward"]["time"] = -0.01
    assert refusal(load_resume, stored, []) == (
        "stored task.reward.time is not a key of this version: if an older version wrote it, use "
        "that version."
    )


def test_a_long_word_is_shortened_where_resume_refuses_it():
    assert len(refusal(load_resume, to_dict(load_train([])), ["seed=" + "9" * 4000])) < 300


@pytest.mark.parametrize("word", ["arenas=256", "stage=s3", "algo.clip_epsilon=0.1", "run=3"])
def test_resume_refuses_other_keys(word):
    stored = to_dict(load_train([]))
    assert refusal(load_resume, stored, [word]) == (
        f"{word} cannot be given: a resumed run keeps its settings, and only budget, "
        "devices, resume, run.*, streams, extensions may change."
    )


def test_resume_checks_keys_and_values():
    stored = to_dict(load_train([]))
    assert refusal(load_resume, stored, ["budgt=3"]) == ("budgt is not a key: did you mean budget?")
    assert (
        refusal(load_resume, stored, ["run.episodes=3"]) == "run.episodes is 3: give true or false."
    )
    assert refusal(load_resume, stored, ["budget=[1"]).startswith(
        "budget is '[1', which cannot be read: "
    )
    assert refusal(load_resume, stored | {"arenas": 3}, []).startswith("stored arenas is 3, but ")
