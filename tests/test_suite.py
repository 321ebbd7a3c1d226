"""Tests the command that draws suites: what it chooses, writes and refuses."""

import sys
from pathlib import Path
from typing import Any

import pytest
import steering

from swarmjax import command, suite
from swarmjax.config import reading
from swarmjax.evaluate import cells
from swarmjax.suite import SuiteConfig

TEXT = """# What it is,
# in two lines.
name: tiny
cells:
  - name: one
    stage: s1
    levels: 2
    seed: 1000001
  - name: two
    stage: {robots: 2, side: 0.6, obstacles: 1}
    levels: 3
    seed: 1000002
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TEXT)
    return path


def _command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["suite", *words])
    return command.run("suite", suite.main, SuiteConfig)


def test_digests_are_written_and_held_to(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _command(monkeypatch, f"suite={file}") == 2
    assert "cell one of suite tiny has no digest" in capsys.readouterr().err
    assert _command(monkeypatch, f"suite={file}", "write=true") == 0
    written = file.read_text()
    lines = [line for line in written.splitlines(keepends=True) if "digest" not in line]
    assert "".join(lines) == TEXT
    out = file.with_name("levels.npz")
    assert _command(monkeypatch, f"suite={file}", f"out={out}") == 0
    drawn, read = cells.draw(str(file)), cells.read(out)
    assert [cell.digest for cell in read.cells] == [cell.digest for cell in drawn.cells]
    printed = capsys.readouterr().out
    assert drawn.cells[1].digest[:12] in printed
    assert _command(monkeypatch, f"suite={file}", "write=true") == 0
    assert file.read_text() == written
    file.write_text(written.replace("seed: 1000002", "seed: 1000003"))
    capsys.readouterr()
    assert _command(monkeypatch, f"suite={file}") == 2
    assert "cell two of suite tiny has the digest " in capsys.readouterr().err


def test_step_limits_are_listed(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(f"{TEXT}    steps: 2345\n")
    assert _command(monkeypatch, f"suite={file}", "write=true") == 0
    head, *rows = (line.split() for line in capsys.readouterr().out.splitlines())
    # A side, such as 0.6 m, is two words in the printed row.
    column = head.index("steps") + 1
    assert [row[column] for row in rows] == ["-", "2345"]


def test_a_friction_of_hulls_is_listed_and_refused_as_that_of_a_robot(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(f"{TEXT}    hull_friction: 0.7\n")
    assert _command(monkeypatch, f"suite={file}", "write=true") == 0
    head, *rows = (line.split() for line in capsys.readouterr().out.splitlines())
    column = head.index("friction") + 1
    assert [row[column] for row in rows] == ["-", "0.7"]
    file.write_text(f"{TEXT}    hull_friction: 0.01\n")
    assert _command(monkeypatch, f"suite={file}") == 2
    assert "hull_friction is 0.01" in capsys.readouterr().err


def test_a_write_that_fails_leaves_the_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(path: Path, text: str) -> None:
        with path.open("w") as half:
            half.write(text[: len(text) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", fill)
    assert _command(monkeypatch, f"suite={file}", "write=true") == 2
    assert file.read_text() == TEXT
    assert list(file.parent.iterdir()) == [file]


WORDS = (
    "no",
    "ON",
    "null",
    "Null",
    "True",
    "y",
    "007",
    "1_0",
    "1e5",
    "0x1f",
    "-",
    "2001-01-01",
    "é",
)


@pytest.mark.parametrize("word", [*WORDS, "12e" + "4" * 61, "real", "a-b_c"])
def test_words_that_yaml_could_read_otherwise_read_back(tmp_path: Path, word: str) -> None:
    content = {"name": word, "cells": [{"name": word, "stage": {"name": word, "robots": 1}}]}
    path = tmp_path / "x.yaml"
    path.write_text(suite.to_yaml(content))
    assert reading.read_yaml(path) == content


def test_a_written_suite_reads_back(tmp_path: Path) -> None:
    content: dict[str, Any] = {
        "name": "x",
        "cells": [
            {
                "name": "007",
                "stage": {"robots": 3, "side": [0.9, 1.1], "level": "random"},
                "realism": None,
                "episodes": list(range(1000, 1300)),
                "digest": "12" * 32,
            }
        ],
    }
    path = tmp_path / "x.yaml"
    path.write_text(suite.to_yaml(content))
    assert reading.read_yaml(path) == content


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["out={tmp}/x.csv"], "out is {tmp}/x.csv: give a file .npz."),
        (["write=true", "out={tmp}/tiny.yaml/x.npz"], "{tmp}/tiny.yaml/x.npz cannot be written: "),
        (["level=1"], "level is not a key"),
    ],
)
def test_the_command_refuses_in_one_sentence(
    file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    sentence: str,
) -> None:
    steering.write(tmp_path / "p.npz")
    words = [word.format(tmp=tmp_path) for word in words]
    assert _command(monkeypatch, f"suite={file}", *words) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"swarmjax.suite: error: {sentence.format(tmp=tmp_path)}")
    assert printed.count("\n") == 1
