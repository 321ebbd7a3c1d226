"""Runs the examples as they are written, each in an empty folder."""

import os
import subprocess
import sys
from pathlib import Path

import extensions
import pytest


def _run(tmp_path: Path, name: str, *arguments: str) -> str:
    path = extensions.EXAMPLES / name
    done = subprocess.run(
        [sys.executable, str(path), *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_arenas_are_stepped_at_random_and_drawn(tmp_path: Path) -> None:
    assert _run(tmp_path, "random_arenas.py").startswith("12,800 arena steps, mean reward ")
    assert (tmp_path / "random_arenas.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_own_pieces_are_trained_with_and_judged(tmp_path: Path) -> None:
    said = _run(tmp_path, "train_own_pieces.py", "4096")
    assert said.splitlines()[-1].endswith(" % of the targets on ring")
    assert len(list(tmp_path.glob("runs/*/policy.npz"))) == 1


@pytest.mark.slow
def test_an_arena_drawn_as_text_is_trained_and_judged(tmp_path: Path) -> None:
    words = ["arenas=8", "algo.num_minibatches=2", "budget=2048", "run.tensorboard=false"]
    stage = extensions.EXAMPLES / "two_rooms.yaml"
    _command(tmp_path, "train", f"stage={stage}", *words, "run.dir=run")
    said = _command(tmp_path, "evaluate", "policy=run/policy.npz", "episodes=1", "workers=1")
    assert "stage two_rooms" in said


def _command(tmp_path: Path, name: str, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", f"swarmjax.{name}", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(extensions.EXAMPLES.parent)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr
