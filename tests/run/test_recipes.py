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
        "stage: s3\nalgo:\n  hidden_sizes: [32, 16]\n  memory: gru\n"
        "  network: null\nrobot: wheeled\nrealism:\n  speed_noise: 0.1\n"
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


def test_an_unknown_recipe_is_refused() -> None:
    known = ", ".join(files.choices("recipes"))
    assert refusal(load_train, ["recipe=world"]) == (
        f"recipe is 'world': give worlds (the most similar name) or one of {known}, or the path of "
        "a .yaml file."
    )


def test_a_recipe_may_extend_another(own: Path) -> None:
    other = own.with_name("other.yaml")
    other.write_text("recipe: mine.yaml\nbudget: 1e6\nalgo:\n  hidden_sizes: [8]\n")
    expected = load_train([f"recipe={own}", "budget=1e6", "algo.hidden_sizes=[8]"])
    assert to_dict(load_train([f"recipe={other}"])) == to_dict(expected)


def test_recipes_may_form_a_chain(own: Path) -> None:
    own.write_text("recipe: worlds\nbudget: 1e6\n")
    third = own.with_name("third.yaml")
    third.write_text("recipe: mine.yaml\nseed: 3\n")
    expected = load_train(["recipe=worlds", "budget=2e6", "seed=3"])
    assert load_train([f"recipe={third}", "budget=2e6"]) == expected


@pytest.mark.parametrize("base", ["mine.yaml", "other.yaml", "../{folder}/other.yaml"])
def test_a_recipe_that_extends_itself_is_refused(own: Path, base: str) -> None:
    own.write_text(f"recipe: {base.format(folder=own.parent.name)}\n")
    own.with_name("other.yaml").write_text("recipe: mine.yaml\n")
    said = refusal(load_train, [f"recipe={own}"])
    assert said.startswith(f"{own.parent}/")
    assert said.endswith(" extends itself: remove the key `recipe` from one file.")


@pytest.mark.parametrize(
    ("base", "expected"),
    [
        ("world", "recipe is 'world': give worlds (the most similar name) or one of w"),
        (
            "[worlds]",
            "{own}: recipe is ['worlds']: give the name of a recipe, or the path of a .yaml file.",
        ),
    ],
)
def test_a_wrong_base_names_the_file(own: Path, base: str, expected: str) -> None:
    own.write_text(f"recipe: {base}\n")
    assert refusal(load_train, [f"recipe={own}"]).startswith(expected.format(own=own))


@pytest.mark.parametrize("base", ["missing.yaml", "link.yaml"])
def test_a_base_that_cannot_be_found_is_refused(own: Path, base: str) -> None:
    own.with_name("link.yaml").symlink_to("link.yaml")
    own.write_text(f"recipe: {base}\n")
    assert refusal(load_train, [f"recipe={own}"]) == (
        f"recipe is '{own.with_name(base)}', but this file does not exist: check the path."
    )


def test_a_stage_written_out_needs_one_that_it_changes(own: Path) -> None:
    own.write_text("stage: {name: mine, robots: 3, side: 1.0}\n")
    assert refusal(load_train, [f"recipe={own}"]) == (
        "stage.robots cannot be given for curriculum, a curriculum: choose one stage, as in "
        "stage=s6 (in a recipe: 'stage: s6', and 'stage.robots: 3' below it)."
    )
    own.write_text("stage: s6\nstage.robots: 3\n")
    assert load_train([f"recipe={own}"]).stage == load_train(["stage=s6", "stage.robots=3"]).stage


def test_an_unknown_key_names_the_file(own: Path) -> None:
    own.write_text("stages: s3\n")
    assert refusal(load_train, [f"recipe={own}"]) == (
        f"{own}: stages is not a key: did you mean stage?"
    )


def test_a_resumed_run_keeps_its_settings(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    said = refusal(load_run, ["recipe=worlds", f"resume={tmp_path}"])
    assert said.startswith("recipe=worlds cannot be given: a resumed run keeps")
