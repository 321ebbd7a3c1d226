"""Tests the command that draws suites: what it chooses, writes and refuses."""

import sys
from pathlib import Path

import pytest
import steering

from swarmjax import command, suite
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
    shape: cross
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TEXT)
    return path


def _command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["suite", *words])
    return command.run("suite", suite.main, SuiteConfig)


def test_digests_are_shown_and_held_to(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = file.with_name("levels.npz")
    assert _command(monkeypatch, f"suite={file}", f"out={out}") == 0
    drawn, read = cells.draw(str(file)), cells.read(out)
    assert [cell.digest for cell in read.cells] == [cell.digest for cell in drawn.cells]
    assert drawn.cells[1].digest in capsys.readouterr().out
    recorded = f"{TEXT}    digest: {drawn.cells[1].digest}\n"
    file.write_text(recorded)
    assert _command(monkeypatch, f"suite={file}") == 0
    file.write_text(recorded.replace("seed: 1000002", "seed: 1000003"))
    capsys.readouterr()
    assert _command(monkeypatch, f"suite={file}") == 2
    assert "cell two of suite tiny has the digest " in capsys.readouterr().err


def test_a_friction_of_hulls_is_refused_as_that_of_a_robot(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(f"{TEXT}    hull_friction: 0.01\n")
    assert _command(monkeypatch, f"suite={file}") == 2
    assert "hull_friction is 0.01" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["out={tmp}/x.csv"], "out is {tmp}/x.csv: give a file .npz."),
        (["out={tmp}/tiny.yaml/x.npz"], "{tmp}/tiny.yaml/x.npz cannot be written: "),
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
