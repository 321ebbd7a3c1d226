"""Tests the `--help` texts and the examples of every command."""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import policies
import pytest

from swarmjax import command
from swarmjax.config import ConfigError, files, section, to_dict
from swarmjax.config.section import Section
from swarmjax.evaluate import __main__ as evaluate
from swarmjax.evaluate import trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.export.config import ExportConfig
from swarmjax.replay.config import ReplayConfig
from swarmjax.report.config import ReportConfig
from swarmjax.reproduce.config import ReproduceConfig
from swarmjax.run.load_settings import load_as, load_run, load_train
from swarmjax.run.settings import ProbeConfig, TrainConfig
from swarmjax.task.stage_files import load_levels
from swarmjax.watch.config import WatchConfig

# The loader and the settings class of each command.
COMMANDS: dict[str, tuple[Callable[[Sequence[str]], object], type[Section]]] = {
    "swarmjax.train": (load_run, TrainConfig),
    "swarmjax.probe": (partial(load_as, ProbeConfig), ProbeConfig),
    "swarmjax.evaluate": (partial(load_levels, EvaluateConfig), EvaluateConfig),
    "swarmjax.export": (partial(files.load, ExportConfig), ExportConfig),
    "swarmjax.report": (partial(files.load, ReportConfig), ReportConfig),
    "swarmjax.replay": (partial(load_levels, ReplayConfig), ReplayConfig),
    "swarmjax.reproduce": (partial(files.load, ReproduceConfig), ReproduceConfig),
    "swarmjax.watch": (partial(files.load, WatchConfig), WatchConfig),
}
EVERY_EXAMPLE = [
    (name, line.partition(f"python -m {name}")[2])
    for name in COMMANDS
    for line in command._examples(name)
    if line.startswith("  python ")
]


@pytest.mark.parametrize(("name", "words"), EVERY_EXAMPLE)
def test_an_example_is_taken_by_its_command(
    name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "runs" / "first").mkdir(parents=True)
    (tmp_path / "runs" / "first" / "config.json").write_text(json.dumps(to_dict(load_train([]))))
    monkeypatch.chdir(tmp_path)
    load, _ = COMMANDS[name]
    load(shlex.split(words))


def test_every_command_has_examples() -> None:
    assert {name for name, _ in EVERY_EXAMPLE} == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_first_help_fits_a_screen(name: str) -> None:
    text = command.help_text(COMMANDS[name][1], name)
    assert text.startswith(f"usage: python -m {name} key=value ...\n")
    assert text.count("\n") < 50


@pytest.mark.parametrize("name", COMMANDS)
def test_all_keys_are_listed_once(name: str) -> None:
    cls = COMMANDS[name][1]
    listed = command.help_text(cls, name, ["all"]).splitlines()
    assert [line.split("=")[0].strip() for line in listed] == list(section.keys(cls))


def test_a_section_is_listed_alone() -> None:
    lines = command.help_text(TrainConfig, "swarmjax.train", ["task.reward"]).splitlines()
    assert lines
    assert all(line.startswith("  task.reward.") for line in lines)


def test_a_key_is_listed_alone() -> None:
    (line,) = command.help_text(TrainConfig, "swarmjax.train", ["algo.discount"]).splitlines()
    assert line.startswith("  algo.discount=0.998 ")


def test_every_section_says_how_it_is_listed() -> None:
    text = command.help_text(TrainConfig, "swarmjax.train")
    for name in section.sections(TrainConfig):
        assert f"\n  --help {name} " in text


def test_a_topic_that_does_not_exist_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"^--help algos is not a topic: give a key, or one of .*all"
    ):
        command.help_text(TrainConfig, "swarmjax.train", ["algos"])


def _shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs a line of bash, in which $RUN stands for `python -m swarmjax`."""
    run = shlex.join([sys.executable, "-m", "swarmjax"])
    return subprocess.run(
        ["bash", "-c", line.replace("$RUN", run)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_command_whose_reader_is_gone_ends_without_a_traceback(tmp_path: Path) -> None:
    done = _shell("$RUN.report --help all | true; exit ${PIPESTATUS[0]}", tmp_path)
    assert (done.returncode, done.stderr) in ((1, ""), (0, ""))  # 0 if it wrote before `true` ended


def test_a_worker_that_was_killed_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    policies.saved(tmp_path / "policy.npz")
    words = [f"policy={tmp_path / 'policy.npz'}", "stage=s1", "episodes=4", "workers=2"]
    monkeypatch.setattr(sys, "argv", ["evaluate", *words])
    # A process that is killed before it has begun, as by the kernel when memory runs out.
    monkeypatch.setattr(trials, "_begin_worker", partial(os._exit, 9))
    assert command.run("evaluate", evaluate.main, EvaluateConfig) == 1
    assert capsys.readouterr().err.endswith(
        "swarmjax.evaluate: error: a worker process died before its work was done, perhaps because "
        "memory ran out: give fewer workers, as in workers=1.\n"
    )
