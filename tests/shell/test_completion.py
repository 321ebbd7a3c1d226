"""Checks the words that shells offer after `swarmjax`."""

import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Literal

import pytest
from sentences import refusal

from swarmjax.config import section
from swarmjax.shell import completion
from swarmjax.shell.commands import COMMANDS, settings

BASH = """
source {script}
COMP_LINE=$1
COMP_POINT=${{#COMP_LINE}} COMP_CWORD=$2
COMP_WORDS=("${{@:3}}")
_swarmjax
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with the completion script of each shell, and a policy."""
    folder = tmp_path_factory.mktemp("completion")
    for shell in completion.SHELLS:
        (folder / f"script.{shell}").write_text(completion.script(shell))
    (folder / "mine.npz").touch()
    return folder


def _bash(folder: Path, line: str) -> list[str]:
    """Returns the words that bash offers for the end of a line.

    The sign `=` separates words, as by default.
    """
    words = line.split(" ")
    code = BASH.format(script="script.bash")
    done = subprocess.run(
        ["bash", "--norc", "-c", code, "bash", line, str(len(words) - 1), *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.stderr
    return done.stdout.split()


def _fish(folder: Path, line: str) -> list[str]:
    """Returns the words that fish offers for the end of a line, without their descriptions."""
    done = subprocess.run(
        ["fish", "-N", "-c", f"source script.fish; complete -C {shlex.quote(line)}"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"HOME": str(folder), "PATH": "/usr/bin:/bin"},
    )
    assert not done.stderr
    return [each.partition("\t")[0] for each in done.stdout.splitlines()]


# The words that bash offers for the end of a line. Bash replaces only the part after `=`.
OFFERED = [
    ("swarmjax ver", {"verify"}),
    ("swarmjax --vers", {"--version"}),
    ("swarmjax --completion z", {"zsh"}),
    ("swarmjax train --h", {"--help"}),
    ("swarmjax train st", {"stage=", "stage.", "streams="}),
    ("swarmjax train task.re", {"task.reward."}),
    ("swarmjax train algo.adv", {"algo.advantage="}),
    ("swarmjax train algo.advantage=", {"gae", "monte_carlo"}),
    ("swarmjax train seed=0 run.dry=t", {"true"}),
    ("swarmjax suite suite=headl", {"headline"}),
    ("swarmjax evaluate policy=mi", {"mine.npz"}),
    ("swarmjax verify arenas", set()),
]


@pytest.mark.parametrize(("line", "offered"), OFFERED)
def test_bash_completes(scripts: Path, line: str, offered: set[str]) -> None:
    assert set(_bash(scripts, line)) == offered


@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
@pytest.mark.parametrize(("line", "offered"), OFFERED)
def test_fish_completes(scripts: Path, line: str, offered: set[str]) -> None:
    key, equals, _ = line.rpartition(" ")[2].partition("=")
    assert set(_fish(scripts, line)) == {
        f"{key}{equals}{each}" if equals else each for each in offered
    }


@pytest.mark.parametrize("shell", completion.SHELLS)
def test_a_shell_can_read_its_script(scripts: Path, shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")
    subprocess.run([shell, "-n", scripts / f"script.{shell}"], check=True)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_table_has_every_key_of_a_command(name: str) -> None:
    keys = [line.split(" ")[1] for line in completion.table(name)]
    assert len(keys) == len(set(keys))
    assert set(keys) >= section.keys(settings(name)).keys()


def test_choices_of_a_key_follow_its_type() -> None:
    assert completion.choices(Literal["a", "b"] | None) == ["a", "b", "null"]
    assert completion.choices(bool) == ["true", "false"]
    assert completion.choices(str) == ["@file"]
    assert completion.choices(int | tuple[float, float]) == []


def test_a_shell_that_is_not_known_is_refused() -> None:
    assert refusal(completion.script, "csh") == (
        "--completion is 'csh': give one of bash, zsh, fish."
    )
