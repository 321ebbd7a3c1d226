"""Checks renamed and removed keys: typed ones are refused with advice, stored ones are read."""

import json

import pytest
from sentences import refusal

from swarmjax.config import build, to_dict
from swarmjax.config.section import modernise
from swarmjax.run.load_settings import from_stored, load_resume, load_train
from swarmjax.run.settings import TrainConfig

RENAMED = {
    "algo.rollout": ("algo.rollout_length", 16),
    "algo.minibatches": ("algo.num_minibatches", 4),
    "algo.hidden": ("algo.hidden_sizes", [32]),
    "algo.clip": ("algo.clip_epsilon", 0.1),
    "algo.returns": ("algo.advantage", "monte_carlo"),
    "algo.output": ("algo.mean_activation", "tanh"),
    "algo.gradient": ("algo.update_backend", "autodiff"),
    "task.reward.time": ("task.reward.step_penalty", -0.01),
    "start": ("init_from", "runs/a"),
    "start_std": ("init_from_std", "reset"),
}
GONE = ("contact_limit", "contact_price_rate", "contact_price_arrivals")


@pytest.mark.parametrize(("old", "new"), [(old, new) for old, (new, _) in RENAMED.items()])
def test_an_old_key_is_refused_with_its_new_name(old: str, new: str) -> None:
    assert refusal(load_train, [f"{old}=1"]) == f"{old} is called {new} now: give {new}."


def test_stored_settings_are_read_by_their_old_names() -> None:
    new = to_dict(load_train(["algo.gae_lambda=null", "algo.time_out=null"]))
    new["algo"] |= {"gae_lambda": None, "time_out": None}
    old = {**new, "algo": dict(new["algo"]), "task": {**new["task"]}}
    old["task"]["reward"] = dict(new["task"]["reward"])
    for name, (key, value) in RENAMED.items():
        *path, last = key.split(".")
        section = old
        for part in path:
            section = section[part]
        del section[last]
        section[name.rpartition(".")[2]] = value
    found = to_dict(from_stored(old))
    for key, value in RENAMED.values():
        held = found
        for part in key.split("."):
            held = held[part]
        assert held == value


def test_a_stored_key_that_was_never_one_is_refused() -> None:
    stored = to_dict(load_train([])) | {"never": 1}
    assert refusal(from_stored, stored).startswith("never is not a key: ")


def test_what_is_no_section_is_left_for_the_reader_to_refuse() -> None:
    assert modernise(TrainConfig, 3) == 3
    assert modernise(TrainConfig, {"algo": 3}) == {"algo": 3}


@pytest.mark.parametrize("key", GONE)
def test_keys_of_a_price_that_adapts_are_refused_with_what_to_give_instead(key: str) -> None:
    assert refusal(load_train, [f"algo.{key}=0.5"]) == (
        f"algo.{key} is no longer a key: give a negative task.reward.robot_contact instead."
    )


def test_a_solver_is_refused_by_its_old_name() -> None:
    sentence = "sim.solver is newton, which is called mjx now: give mjx."
    assert refusal(load_train, ["sim.solver=newton"]) == sentence
    stored = to_dict(load_train([]))
    stored["sim"]["solver"] = "newton"
    assert refusal(build, TrainConfig, stored) == sentence


def test_what_older_versions_stored_is_read_with_its_old_names_and_keys() -> None:
    expected = load_train(["sim.solver=mjx", "algo.clip_epsilon=0.1"])
    stored = to_dict(expected)
    stored["sim"]["solver"] = "newton"
    stored["algo"] |= dict.fromkeys(GONE, 0.5)
    before = json.dumps(stored)
    assert from_stored(stored) == expected
    assert load_resume(stored, []) == expected
    assert json.dumps(stored) == before
    assert from_stored(to_dict(expected)) == expected
    # A key that never existed is still refused, and so is a section without keys.
    stored["algo"]["contact_prize"] = 0.5
    assert refusal(from_stored, stored, "stored ").startswith("stored algo.contact_prize is not a ")
    assert refusal(from_stored, stored | {"algo": 3}, "stored ").startswith("stored algo is 3: ")
