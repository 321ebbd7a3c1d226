"""Tests recipes: files of settings that typed words override."""

from pathlib import Path

import pytest
from sentences import refusal

from swarmjax.config import files, to_dict
from swarmjax.run.load_settings import load_run, load_train


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A user's recipe."""
    path = tmp_path / "mine.yaml"
    path.write_text(
        "stage: s3\nrun:\n  dir: null\nalgo:\n  hidden_sizes: [32, 16]\n  memory: gru\n"
        "  memory_size: null\nrobot: wheeled\nrealism:\n  speed_noise: 0.1\n"
    )
    return path


@pytest.mark.parametrize("name", files.choices("recipes"))
def test_every_recipe_is_valid(name: str) -> None:
    assert to_dict(load_train([f"recipe={name}"])) != to_dict(load_train([]))


def test_a_recipe_sets_values_of_every_kind(own: Path) -> None:
    typed = ["stage=s3", "algo.hidden_sizes=[32,16]", "algo.memory=gru", "robot=wheeled"]
    expected = load_train([*typed, "realism.speed_noise=0.1"])
    assert to_dict(load_train([f"recipe={own}"])) == to_dict(expected)


@pytest.mark.parametrize(
    "typed", [["recipe=worlds", "budget=1e7"], ["budget=1e7", "recipe=worlds"]]
)
def test_typed_words_win(typed: list[str]) -> None:
    found = load_train(typed)
    assert (found.budget, found.algo.memory) == (10_000_000, "gru")


def test_null_is_no_recipe() -> None:
    assert load_train(["recipe=null"]) == load_train([])


def test_a_run_holds_the_settings_and_not_the_recipe() -> None:
    assert "recipe" not in to_dict(load_train(["recipe=worlds"]))


def test_a_recipe_may_leave_the_number_of_arenas_open(own: Path) -> None:
    own.write_text("arenas: auto\n")
    assert load_run([f"recipe={own}"])[1]


def test_an_unknown_recipe_is_refused() -> None:
    assert refusal(load_train, ["recipe=world"]) == (
        "recipe is 'world': give one of worlds (nearest: worlds), or a file .yaml."
    )


def test_a_recipe_in_a_recipe_is_refused(own: Path) -> None:
    own.write_text("recipe: worlds\n")
    assert refusal(load_train, [f"recipe={own}"]) == (
        f"{own} names another recipe: remove the key recipe."
    )


def test_an_unknown_key_names_the_file(own: Path) -> None:
    own.write_text("stages: s3\n")
    assert refusal(load_train, [f"recipe={own}"]) == (
        f"{own}: stages is not a key: did you mean stage?"
    )


def test_a_resumed_run_keeps_its_settings(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    said = refusal(load_run, ["recipe=worlds", f"resume={tmp_path}"])
    assert said.startswith("recipe='worlds' cannot be given: resume keeps the rest")
