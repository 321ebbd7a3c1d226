"""Tests that no command replaces a file that it did not write."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import policies
import pytest
from runs import row, write
from sentences import refusal

from swarmjax import outputs
from swarmjax.evaluate import __main__ as evaluate
from swarmjax.export import __main__ as export
from swarmjax.replay import __main__ as replay
from swarmjax.report import __main__ as report
from swarmjax.reproduce import __main__ as reproduce

Main = Callable[[Sequence[str]], int]
# For each command: its words, the key of its output, the output, and the file that would be lost.
COMMANDS: dict[str, tuple[Main, list[str], str, str]] = {
    "evaluate folder": (
        evaluate.main,
        ["policy=policy.npz", "stage=s1", "episodes=1", "steps=2", "workers=1", "out=judged"],
        "out",
        "judged/levels.csv",
    ),
    "evaluate file": (
        evaluate.main,
        ["policy=policy.npz", "stage=s1", "episodes=1", "steps=2", "workers=1", "out=mine.json"],
        "out",
        "mine.json",
    ),
    "replay": (
        replay.main,
        ["policy=policy.npz", "stage=s1", "steps=2", "out=page.html"],
        "out",
        "page.html",
    ),
    "report": (report.main, ["run=run", "out=told"], "out", "told/report.html"),
    "export npz": (export.main, ["policy=policy.npz", "out=b.npz"], "out", "b.npz"),
    "export onnx": (export.main, ["policy=policy.npz", "format=onnx"], "out", "policy.onnx"),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a policy and a run."""
    monkeypatch.chdir(tmp_path)
    policies.saved(Path("policy.npz"))
    write(Path("run"), [row(0)])
    return tmp_path


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.usefixtures("folder")
def test_a_file_of_the_user_is_refused_before_the_work(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    main, words, key, lost = COMMANDS[name]
    Path(lost).parent.mkdir(exist_ok=True)
    Path(lost).write_text("mine")
    monkeypatch.setattr(evaluate, "evaluate", None)  # would end in a TypeError
    monkeypatch.setattr(replay, "replay", None)
    assert refusal(main, words) == (
        f"{key} is {lost}, which swarmjax did not write or which was changed since: give another "
        "name, or overwrite=true."
    )
    assert Path(lost).read_text() == "mine"


@pytest.mark.parametrize("name", ["evaluate folder", "replay", "report", "export npz"])
@pytest.mark.usefixtures("folder")
def test_a_command_replaces_its_own_output_and_on_request_any_file(name: str) -> None:
    main, words, _, written = COMMANDS[name]
    assert main(words) == main(words) == 0
    Path(written).write_text("mine")
    assert main([*words, "overwrite=true"]) == 0
    assert Path(written).read_bytes() != b"mine"
    assert main(words) == 0


@pytest.mark.usefixtures("folder")
def test_a_video_of_the_user_is_refused() -> None:
    Path("film.mp4").write_text("mine")
    words = ["policy=policy.npz", "stage=s1", "steps=2", "video=film.mp4"]
    assert refusal(replay.main, words).startswith("video is film.mp4, which swarmjax did not write")


@pytest.mark.usefixtures("folder")
def test_a_reproduction_wants_an_empty_folder() -> None:
    assert refusal(reproduce.main, ["out=run"]) == (
        "out is run, which is not empty: give a new or an empty folder, or resume=run to go on "
        "with the reproduction in it."
    )


def test_notes_that_are_damaged_count_as_none(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("a")
    outputs.note([path])
    outputs.check("out", [path], overwrite=False)
    (tmp_path / outputs.NOTES).write_text("[")
    assert "out is " in refusal(partial(outputs.check, "out", [path], overwrite=False))
