"""Tests how words of a command line and files of configs/ become settings."""

import shutil
from pathlib import Path

import pytest
from sentences import refusal

from swarmjax.config import files
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.task.stage_config import StageConfig

ROOT = Path(files.__file__).resolve().parents[2]


@pytest.fixture
def own_configs(tmp_path, monkeypatch):
    """Returns a copy of configs/; a test may write to the copy."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.setattr(files, "_PACKAGE", tmp_path / "swarmjax")
    return tmp_path / "configs"


# Words


def test_groups_and_keys_in_any_order():
    train = load_train(
        ["stage.side=0.9", "robot=planar", "stage=s3", "algo=ppo", "algo.clip_epsilon=0.1"]
    )
    (stage,) = train.stage
    assert (stage.name, stage.side, stage.robots) == ("s3", 0.9, 3)
    assert train.stage_name == "s3"
    assert train.algo.clip_epsilon == 0.1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["stage=curriculum", "stage.sequence.a=1"],
            "stage.sequence is {'a': 1}: give a list, as in [s1,s2].",
        ),
        (
            ["stage.sequence=[s1]", "stage.sequence.a.b=1"],
            "stage.sequence.a.b cannot be set if stage.sequence is ['s1']: leave out one of the "
            "two.",
        ),
    ],
)
def test_a_key_within_a_list_is_refused(words, sentence):
    assert refusal(load_train, words) == sentence


def test_of_a_key_given_twice_the_last_counts():
    train = load_train(["stage=s1", "seed=1", "stage=s2", "seed=2"])
    assert (train.stage_name, train.seed) == ("s2", 2)


def test_keys_that_no_file_holds_can_be_given():
    train = load_train(["task.reward.contact=-0.5", "sim.substeps=null", "run.tensorboard=false"])
    assert train.task.reward.contact == -0.5
    assert train.sim.substeps is None
    assert train.run.tensorboard is False


@pytest.mark.parametrize(
    "path",
    [
        "runs/a=b",
        "a, b (1)",
        "it's",
        "~/é",
        "007",
        "1e3",
        "C:\\a\\",
        "[x]",
        "a: b",
        "a #b",
        "\u2028",
    ],
)
def test_paths_are_taken_as_they_stand(path):
    assert load_train([f"run.dir={path}"]).run.dir == path


@pytest.mark.parametrize(("word", "made"), [("null", None), ("'null'", "null"), ('"a b"', "a b")])
def test_null_and_quotes_keep_their_meaning_for_text(word, made):
    assert load_train([f"run.dir={word}"]).run.dir == made


def test_a_word_does_not_read_the_environment(monkeypatch):
    monkeypatch.setenv("SCRATCH", "/scratch")
    assert load_train(["run.dir=${oc.env:SCRATCH}/a"]).run.dir == "${oc.env:SCRATCH}/a"


@pytest.mark.parametrize(
    "value",
    ["s1", "null", "a b", "'", '"', "\\", "é", "1e3", "", True, None, -1.5, [1, ["x", None]]],
)
def test_what_is_written_as_a_word_is_read_again(value):
    word = f"task={files.write(value)}"  # a section: its words are read as YAML, whatever they are
    assert files.parse(TrainConfig, [word]) == {"task": value}


def test_a_sequence_of_ones_own():
    train = load_train(["stage.sequence=[s4,s2]"])
    assert [stage.name for stage in train.stage] == ["s4", "s2"]
    assert train.stage_name == "curriculum"


def test_stage_name_of_a_configuration_made_by_hand():
    one, two = StageConfig(name="a", robots=1, side=1.0), StageConfig(name="b", robots=1, side=1.0)
    assert TrainConfig(stage=(one,), stage_name="other").stage_name == "a"
    assert TrainConfig(stage=(one, two)).stage_name == "a-b"


# Files


def test_a_stage_is_one_file(own_configs):
    (own_configs / "stage" / "mine.yaml").write_text("name: mine\nrobots: 4\nside: 1e0\n")
    assert load_train(["stage=mine"]).stage == (StageConfig(name="mine", robots=4, side=1.0),)
    train = load_train(["stage.sequence=[s1,mine]"])
    assert [stage.robots for stage in train.stage] == [2, 4]


def test_a_sequence_takes_names_paths_beside_its_file_and_stages(tmp_path):
    (tmp_path / "wide.yaml").write_text("name: wide\nrobots: 4\nside: 3\n")
    (tmp_path / "mine.yaml").write_text(
        "sequence: [s1, wide.yaml, {name: own, robots: 1, side: 2}]\n"
    )
    train = load_train([f"stage={tmp_path / 'mine.yaml'}"])
    assert [stage.name for stage in train.stage] == ["s1", "wide", "own"]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("name: yours\nrobots: 4\nside: 1\n", "stage.name is 'yours' in mine.yaml"),
        ("name: mine\nside: 1\n", "stage.robots is missing"),
        ("", "stage.robots is missing"),
        ("name: mine\nrobot: 4\nside: 1\n", "stage.robot is not a key: did you mean stage.robots?"),
        ("name: [\n", "mine.yaml"),
        ("- a\n", "mine.yaml"),
        ("sequence: [s1]\nrobots: 3\n", "stage.robots cannot be given for mine"),
    ],
)
def test_an_unsound_stage_file_is_one_sentence(own_configs, text, part):
    (own_configs / "stage" / "mine.yaml").write_text(text)
    assert part in refusal(load_train, ["stage=mine"])


def test_configs_of_an_installed_package(tmp_path, monkeypatch):
    package = tmp_path / "site-packages" / "swarmjax"
    shutil.copytree(ROOT / "configs", package / "configs")
    # Another package's folder is also named configs, and must not be taken for ours.
    (tmp_path / "site-packages" / "configs").mkdir()
    monkeypatch.setattr(files, "_PACKAGE", package)
    assert load_train(["stage=s1"]).stage_name == "s1"
