"""Tests that every command refuses harmful arguments at once, in one sentence."""

import os
import time
from pathlib import Path
from typing import Any

import pytest
from config.test_reading import BOMB
from sentences import refusal
from test_command import COMMANDS

from swarmjax.command import run
from swarmjax.config import section, values
from swarmjax.policy import PolicyError
from swarmjax.report import __main__ as report
from swarmjax.report.config import ReportConfig

SOUND = {
    "swarmjax.train": [],
    "swarmjax.probe": [],
    "swarmjax.evaluate": ["policy=a.npz"],
    "swarmjax.export": ["run=a"],
    "swarmjax.report": ["run=a"],
    "swarmjax.replay": ["policy=a.npz"],
    "swarmjax.reproduce": [],
    "swarmjax.watch": ["run=a"],
}
# The probe takes the words of `train`, with the same code.
OTHERS = {name: cls for name, (_, cls) in COMMANDS.items() if name != "swarmjax.probe"}
TEXTS = [
    (name, key)
    for name, cls in OTHERS.items()
    for key, item in section.keys(cls).items()
    if str in values.options(item.type)
]
NUMBERS = [
    (name, key)
    for name, cls in OTHERS.items()
    for key, item in section.keys(cls).items()
    if {int, float} & {*values.options(item.type)}
]


def _refused(name: str, word: str) -> str:
    """Returns the sentence with which a command refuses an argument, after less than 5 s."""
    began = time.monotonic()
    sentence = refusal(COMMANDS[name][0], [*SOUND[name], word])
    assert time.monotonic() - began < 5.0
    return sentence


@pytest.mark.parametrize(("name", "key"), TEXTS)
@pytest.mark.parametrize("value", ["a\0b", "a\nb", "x" * 300, "a/" + "x" * 300 + "/b", "\udcff"])
def test_text_that_names_no_file_is_refused(name: str, key: str, value: str) -> None:
    sentence = _refused(name, f"{key}={value}")
    assert len(sentence) < 300


@pytest.mark.parametrize(("name", "key"), NUMBERS)
def test_a_number_of_5000_digits_is_refused(name: str, key: str) -> None:
    assert len(_refused(name, f"{key}={'9' * 5000}")) < 300


@pytest.mark.parametrize("name", COMMANDS)
def test_100000_brackets_are_refused(name: str) -> None:
    key = next((key for of, key in NUMBERS if of == name), "out")
    assert len(_refused(name, f"{key}={'[' * 100_000}")) < 300


@pytest.mark.parametrize("group", ["stage", "robot", "realism", "algo"])
@pytest.mark.parametrize("kind", ["bomb", "brackets", "digits", "pipe", "folder", "zero", "large"])
def test_a_hostile_file_of_a_group_is_refused(tmp_path: Path, group: str, kind: str) -> None:
    path = _hostile(tmp_path, kind)
    _refused("swarmjax.train", f"{group}={path}")


@pytest.mark.parametrize("kind", ["bomb", "brackets", "digits", "pipe", "folder", "zero", "large"])
def test_a_hostile_suite_is_refused(tmp_path: Path, kind: str) -> None:
    from swarmjax.evaluate.suite_config import read_suite

    path = _hostile(tmp_path, kind)
    assert str(path) in refusal(read_suite, str(path))


def _hostile(folder: Path, kind: str) -> Path:
    """Makes a file that a command must neither wait for nor trust."""
    path = folder / "mine.yaml"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "zero":
        path.symlink_to("/dev/zero")
    elif kind == "large":
        with path.open("wb") as file:
            file.truncate(2**40)
    else:
        texts = {"bomb": BOMB, "brackets": "a: " + "[" * 100_000, "digits": f"a: {'9' * 4500}"}
        path.write_text(texts[kind])
    return path


def test_a_config_of_100000_brackets_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("[" * 100_000)
    for name, word in (("swarmjax.train", "resume"), ("swarmjax.report", "run")):
        load = report.rows.read_config if name == "swarmjax.report" else COMMANDS[name][0]
        given: Any = tmp_path if name == "swarmjax.report" else [f"{word}={tmp_path}"]
        assert "cannot be read as JSON: " in refusal(load, given)


def test_a_file_that_no_command_foresaw_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> int:
        raise OSError(36, "File name too long", "x" * 999)

    monkeypatch.setattr("sys.argv", ["report", "run=a"])
    assert run("report", fail, ReportConfig) == 2
    said = capsys.readouterr().err
    assert said.endswith("xxx... cannot be used: File name too long.\n")
    assert len(said) < 300


def test_a_policy_that_is_a_pipe_is_refused(tmp_path: Path) -> None:
    from swarmjax import policy_file

    os.mkfifo(tmp_path / "policy.npz")
    with pytest.raises(PolicyError, match="is not a file"):
        policy_file.read(tmp_path / "policy.npz")


def test_speed_that_physics_cannot_bear_is_refused_before_training() -> None:
    sentence = _refused("swarmjax.train", "robot.max_speed=1e300")
    assert sentence.startswith("robot.max_speed is 1e+300: give 0.001 to 5; ")
