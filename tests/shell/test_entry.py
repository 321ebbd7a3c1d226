"""Checks that `swarmjax COMMAND` does the same as `python -m swarmjax.COMMAND`."""

import subprocess
import sys
from pathlib import Path

import pytest

import swarmjax
from swarmjax import command
from swarmjax.shell import entry
from swarmjax.shell.commands import COMMANDS, settings

# Packages that help must not import.
_HEAVY = ("jax", "flax", "optax", "orbax", "matplotlib")


def _main(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["swarmjax", *words])
    return entry.main()


def test_help_lists_every_command_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _main(monkeypatch, "--help") == 0
    lines = capsys.readouterr().out.splitlines()
    for name, each in COMMANDS.items():
        assert f"  {name:<10}  {each.meaning}" in lines
        assert each.meaning.endswith(".")


def test_without_a_command_there_is_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _main(monkeypatch) == 0
    assert capsys.readouterr().out == entry.help_text() + "\n"


def test_version_names_swarmjax_jax_and_mujoco(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import jax
    import mujoco

    assert _main(monkeypatch, "--version") == 0
    told = capsys.readouterr().out
    assert told.startswith(
        f"swarmjax {swarmjax.__version__}, jax {jax.__version__}, mujoco {mujoco.__version__}, "
    )
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["trian"], "'trian' is not a command: did you mean train?"),
        (
            ["xyz"],
            f"'xyz' is not a command: give one of {', '.join(COMMANDS)}.",
        ),
    ],
)
def test_what_is_not_known_is_one_sentence_and_exit_code_2(
    words: list[str],
    sentence: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _main(monkeypatch, *words) == 2
    assert capsys.readouterr().err == f"swarmjax: error: {sentence}\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_is_that_of_its_module(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _main(monkeypatch, name, "--help") == 0
    expected = command.help_text(settings(name), f"swarmjax.{name}")
    assert capsys.readouterr().out == expected + "\n"


def test_help_imports_no_jax() -> None:
    code = (
        "import sys\n"
        "from swarmjax.shell import entry\n"
        "for name in entry.COMMANDS:\n"
        "    sys.argv = ['swarmjax', name, '--help']\n"
        "    entry.main()\n"
        f"sys.exit(','.join(set(sys.modules) & set({_HEAVY!r})))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr == "\n"


@pytest.mark.parametrize(
    "words",
    [
        ["train", "stge=s1"],
        ["evaluate", "policy=absent.npz"],
    ],
)
def test_a_command_ends_as_its_module_does(words: list[str], tmp_path: Path) -> None:
    script = "from swarmjax.shell.entry import main; import sys; sys.exit(main())"
    here, module = (
        subprocess.run(
            [sys.executable, *start, *rest],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        for start, rest in (
            (["-c", script], words),
            (["-m", f"swarmjax.{words[0]}"], words[1:]),
        )
    )
    assert (here.returncode, here.stdout, here.stderr) == (
        module.returncode,
        module.stdout,
        module.stderr,
    )
