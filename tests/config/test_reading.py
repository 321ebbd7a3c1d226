"""Tests that user files are not trusted: a harmful file is refused at once, in one sentence."""

import json
import math
import os
import time
from pathlib import Path

import pytest
from sentences import refusal

from swarmjax.config import reading

BOMB = "\n".join(
    ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (BOMB, "replace the YAML alias *a0 with its value"),
        ("a: &a [*a]", "replace the YAML alias *a"),
        ("[" + "1," * 10_001 + "]", "has more than 10000 values"),
        ("a: " + "[" * 100_000, "lists or mappings are nested more than 32 deep"),
        ("[" * 100_000 + "]" * 100_000, "lists or mappings are nested more than 32 deep"),
        ("a: " + "9" * 4900, "Exceeds the limit (4300 digits)"),
        ("a: 1\na: 2\n", "key 'a' is given twice"),
        ("{[1]: 2}", "key [1] is not text"),
        (
            "a: !!python/object/apply:os.system [ls]",
            "remove the YAML tag 'tag:yaml.org,2002:python/object/apply:os.system'",
        ),
        ("#" * 2**20 + "\n", "more than 1048576 bytes"),
    ],
)
def test_yaml_that_stands_for_too_much_is_refused_at_once(
    tmp_path: Path, text: str, part: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    began = time.monotonic()
    sentence = refusal(reading.read_yaml, path)
    assert sentence.startswith(f"{path} cannot be read: ")
    assert part in sentence
    assert time.monotonic() - began < 5.0


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(
            (text, text)
            for text in ("yes", "on", "0x1f", "2020-01-01", "1:30", "1_000", "<<", "${x}")
        ),
        *(("010", 10), ("-3", -3), ("+3", 3)),
        *(("1e6", 1e6), (".5", 0.5), ("5.", 5.0), ("-.inf", -math.inf)),
        *(("true", True), ("FALSE", False), ("null", None), ("~", None), ("", None)),
        *(("'null'", "null"), ('"1"', "1")),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: object) -> None:
    found = reading.parse_yaml(text, "")
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize("tag", ["!!timestamp", "!!set", "!!binary", "!!str", "!own", "!"])
def test_a_tag_is_refused(tag: str) -> None:
    assert "remove the YAML tag '" in refusal(reading.parse_yaml, f"a: {tag} x", "")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[" * 100_000, "cannot be read as JSON: maximum recursion depth exceeded"),
        ('{"a":' * 40 + "1" + "}" * 40, "lists or mappings are nested more than 32 deep"),
        ("9" * 5000, "Exceeds the limit (4300 digits)"),
        ("{", "cannot be read as JSON: Expecting property name"),
    ],
)
def test_json_that_stands_for_too_much_is_refused(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "mine.json"
    path.write_text(text)
    sentence = refusal(reading.read_json, path)
    assert sentence.startswith(f"{path} cannot be read")
    assert part in sentence


def test_a_pipe_is_refused_without_waiting(tmp_path: Path) -> None:
    path = tmp_path / "pipe.yaml"
    os.mkfifo(path)
    assert refusal(reading.read_text, path) == f"{path} cannot be read: it is not a regular file."


@pytest.mark.parametrize("path", [Path("/dev/zero"), Path("/tmp")])
def test_what_is_no_plain_file_is_refused(path: Path) -> None:
    assert refusal(reading.read_bytes, path) == f"{path} cannot be read: it is not a regular file."


def test_text_that_is_no_unicode_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"a: \xff\n")
    assert refusal(reading.read_text, path) == f"{path} cannot be read: it is not UTF-8 text."


def test_a_large_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(2**40)
    assert "more than 1048576 bytes" in refusal(reading.read_text, path)


@pytest.mark.parametrize("name", ["a\0b", "x" * 300])
def test_a_name_that_no_file_can_have_is_refused(name: str) -> None:
    assert " cannot be read: " in refusal(reading.read_bytes, Path(name))


def test_a_line_without_an_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.jsonl"
    with path.open("wb") as file:
        file.write(json.dumps({}).encode() + b"\n")
        file.truncate(2**30)
    sentence = refusal(list, reading.read_lines(path))
    assert sentence == f"{path} has a line of more than {2**24} bytes."
