"""Tests how commands print numbers."""

import shlex

import pytest

from swarmjax import words


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (0.0213, "0.0213 s"),
        (0.000456, "0.000456 s"),
        (31.24, "31.2 s"),
        (59.94, "59.9 s"),
        (59.96, "1 min 00 s"),
        (75.4, "1 min 15 s"),
        (3599.9, "1 h 00 min"),
        (5000.0, "1 h 23 min"),
    ],
)
def test_a_duration_is_short_and_never_nothing(seconds: float, text: str) -> None:
    assert words.duration(seconds) == text


@pytest.mark.parametrize(("number", "text"), [(0, "0 arenas"), (1, "1 arena"), (2, "2 arenas")])
def test_one_thing_is_singular(number: int, text: str) -> None:
    assert words.count(number, "arena") == text


def test_many_things_have_separators() -> None:
    assert words.count(1_048_576, "arena") == "1,048,576 arenas"


def test_a_plural_may_be_given() -> None:
    assert words.count(2, "policy", "policies") == "2 policies"


def test_a_line_is_broken_between_words() -> None:
    text = "a word " * 40
    assert max(map(len, words.lines(text).splitlines())) <= 120
    assert words.lines(text).split() == text.split()


def test_a_long_path_stays_whole() -> None:
    path = "folder/" * 30
    assert path in words.lines(f"{path}: the report").splitlines()[0]


def test_a_long_command_goes_on_after_a_backslash() -> None:
    command = f"python -m swarmjax.evaluate policy={'a' * 90}"
    said = words.lines(f"done; judge it with: {command.replace(' ', words.GLUE)}")
    first, *rest = said.splitlines()
    assert first == "done; judge it with:"
    assert max(map(len, rest)) <= 120
    assert shlex.split("\n".join(rest).replace("\\\n", "")) == command.split()


def test_a_long_path_loses_its_beginning() -> None:
    assert words.shorten("runs/first/policy.npz", 13) == "...policy.npz"
    assert words.shorten("policy.npz", 13) == "policy.npz"
