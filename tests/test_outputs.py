"""Tests how commands write files."""

from pathlib import Path

import pytest
from runs import row, write
from sentences import refusal

from swarmjax import outputs
from swarmjax.reproduce import __main__ as reproduce


def test_a_file_whose_writing_breaks_off_is_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs.write({tmp_path / "a": b"1"})

    def crash(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", crash)
    with pytest.raises(KeyboardInterrupt):
        outputs.write({tmp_path / "a": b"2"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1"}


def test_a_reproduction_wants_an_empty_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write(Path("run"), [row(0)])
    assert refusal(reproduce.main, ["out=run"]) == (
        "out is run, which is not empty: give a new or an empty folder, or resume=run to continue "
        "the reproduction in it."
    )
