"""The examples run as they are written, in a folder of their own."""

import subprocess
import sys
from pathlib import Path

import extensions


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


def test_arenas_are_stepped_at_random_and_drawn(tmp_path: Path) -> None:
    assert _run(tmp_path, "random_arenas.py").startswith("12,800 arena steps, mean reward ")
    assert (tmp_path / "random_arenas.png").read_bytes().startswith(b"\x89PNG")


def test_own_pieces_are_trained_with_and_judged(tmp_path: Path) -> None:
    said = _run(tmp_path, "train_own_pieces.py", "4096")
    assert said.splitlines()[-1].endswith(" % of the targets on ring")
    assert len(list(tmp_path.glob("runs/*/policy.npz"))) == 1
