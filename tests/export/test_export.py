"""Tests the command that exports: choice of policy, format, output path, and refused settings."""

import hashlib
import json
import math
import sys
from pathlib import Path

import numpy as np
import policies
import pytest
from policies import saved, saved_for_webots
from sentences import refusal

from swarmjax import command, policy_file
from swarmjax.config import build, to_dict
from swarmjax.exit_codes import USER_ERROR
from swarmjax.export import __main__ as export
from swarmjax.export.config import ExportConfig
from swarmjax.run import directory
from swarmjax.run.load_settings import load_train, read_config
from swarmjax.run.policy_export import policy_arrays, policy_meta
from swarmjax.run.settings import TrainConfig

FORMATS = {"npz": "policy.npz", "onnx": "policy.onnx", "c": "policy_c", "webots": "swarmjax_epuck"}


def test_a_deviation_in_the_file_is_at_least_the_smallest_one() -> None:
    learners = "learners/normalizer"
    leaves = {f"{learners}/mean": np.zeros((1, 2)), f"{learners}/variance": np.array([[4.0, 0.0]])}
    # An observation that never varied would otherwise be divided by 0.
    np.testing.assert_array_equal(policy_arrays(leaves)["normalizer/std"], [[2.0, 0.001]])


def _refusal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str
) -> str:
    """Runs the command and returns the sentence with which it is refused."""
    monkeypatch.setattr(sys, "argv", ["export", *words])
    capsys.readouterr()
    assert command.run("export", export.main, ExportConfig) == USER_ERROR
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    return said.err


def _digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("form", ["onnx", "c", "webots"])
def test_a_policy_file_is_exported_beside_itself(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if form == "onnx":
        pytest.importorskip("onnx", reason="needs the package onnx")
    path = tmp_path / "policy.npz"
    saved_for_webots(path) if form == "webots" else saved(path)
    assert export.main([f"policy={path}", f"format={form}"]) == 0
    out = tmp_path / FORMATS[form]
    assert capsys.readouterr().out == f"{out}: the policy of {path}.\n"
    assert set(directory.visible(tmp_path)) == {"policy.npz", FORMATS[form]}
    # Exports to a second place, and again to the same place, give the same bytes.
    other = tmp_path / "other" / FORMATS[form]
    assert export.main([f"policy={path}", f"format={form}", f"out={other}"]) == 0
    once = _digests(tmp_path / "other")
    assert export.main([f"policy={path}", f"format={form}", f"out={other}"]) == 0
    assert _digests(tmp_path / "other") == once
    if form == "onnx":
        assert other.read_bytes() == out.read_bytes()
    else:
        assert _digests(out) == _digests(other)


def test_a_policy_file_is_copied_as_it_is(tmp_path: Path) -> None:
    path, out = tmp_path / "policy.npz", tmp_path / "far" / "copy.npz"
    saved(path)
    assert export.main([f"policy={path}", f"out={out}"]) == 0
    assert out.read_bytes() == path.read_bytes()


def test_the_policy_says_what_it_was_trained_with(tmp_path: Path) -> None:
    trained = load_train(
        ["stage=s1", "robot=wheeled_v2", "realism=real", "task.control_step=0.064", "seed=4"]
    )
    said = policy_meta(trained, update=7, seed=4)
    robot = to_dict(trained.robot)
    sensors = {key: robot.pop(key) for key in [*robot] if key.startswith("sensor_")}
    assert said["robot"] == {"preset": "wheeled_v2"} | robot
    assert said["sensors"]["table"] == sensors["sensor_response"]
    assert (said["robot"]["hull_radius"], said["robot"]["max_wheel_speed"]) == (0.037, 7.536)
    sensors = said["sensors"]
    assert (sensors["preset"], sensors["response"], sensors["range"]) == ("real", "real", 0.04)
    assert sensors["poses"][2] == [0.0, -0.031, -math.pi / 2]  # ps2 looks to the right
    assert said["task"] == {
        "control_step": 0.064,
        "target_radius": 0.05,
        "goal": "navigate",
        "target_speed": 0.0,
        "arrival": "latch",
        "step_limit": 500,
        "observations": [],
    }
    assert (said["realism"], said["extensions"]) == (to_dict(trained.realism), {})
    assert said["observation"]["encoding"] == "metric"
    assert (said["update"], said["seed"]) == (7, 4)
    assert build(TrainConfig, said["config"]) == trained
    policy_file.write(tmp_path / "policy.npz", policies.arrays(), said)  # accepts all of it


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ([], "planar"),
        (["robot=wheeled"], "wheeled"),
        (["robot=planar_v2"], "planar_v2"),
        (["robot.mass=0.2"], "custom"),
    ],
)
def test_a_robot_is_named_by_the_file_that_has_its_numbers(words: list[str], name: str) -> None:
    trained = load_train(["stage=s1", *words])
    assert policy_meta(trained, 0, 0)["robot"]["preset"] == name


@pytest.mark.parametrize(
    ("words", "name"),
    [([], "ideal"), (["realism=real"], "real"), (["realism=real", "realism.mass=null"], "custom")],
)
def test_realism_is_named_by_the_file_that_has_its_numbers(words: list[str], name: str) -> None:
    trained = load_train(["stage=s1", *words])
    assert policy_meta(trained, 0, 0)["sensors"]["preset"] == name


def test_export_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policy.npz"
    saved(path)
    (tmp_path / "file").write_text("mine")
    given = f"policy={path}"
    for words, sentence in {
        (): "run is null and policy is null: give exactly one of the two, as in run=runs/a or",
        (given, "out=copy.npy"): "out is copy.npy, but format is npz: end out with .npz.",
        (given, "format=onnx", "out=a"): "out is a, but format is onnx: end out with .onnx.",
        (given, "format=c", f"out={tmp_path / 'file'}"): "which cannot be written: ",
        (given, "format=c", f"out={tmp_path / 'file' / 'c'}"): "which cannot be written: Not a d",
        (given, f"out={tmp_path / 'file' / 'a.npz'}"): "which cannot be written: ",
        (given, "format=c", "out=."): "out is ., which does not end with a name: add the name of ",
        (given, "format=webots", "out=a/.."): "out is a/.., which does not end with a name: add ",
        ("policy=none.npz", "format=c"): "none.npz is not a file: give the path of a policy.npz.",
    }.items():
        assert sentence in _refusal(monkeypatch, capsys, *words)
    assert {found.name for found in tmp_path.iterdir()} == {"policy.npz", "file"}
    assert (tmp_path / "file").read_text() == "mine"


def test_webots_has_no_targets_that_move(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policy.npz"
    saved(path, task=policies.meta()["task"] | {"goal": "gather"})
    assert "the policy's goal is gather with targets that move: give format=c or onnx" in _refusal(
        monkeypatch, capsys, f"policy={path}", "format=webots", f"out={tmp_path / 'a'}"
    )


def test_export_says_what_onnx_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policy.npz"
    saved(path)
    monkeypatch.setitem(sys.modules, "onnx", None)  # as if onnx were not installed
    sentence = _refusal(monkeypatch, capsys, f"policy={path}", "format=onnx")
    assert "the package onnx is not installed: run uv sync --extra onnx." in sentence
    assert [found.name for found in tmp_path.iterdir()] == ["policy.npz"]


@pytest.mark.parametrize("content", ["[" * 100_000, "[]", "{", "\xff"])
def test_a_config_that_is_none_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(content, encoding="latin-1")
    sentence = refusal(read_config, tmp_path)
    assert str(tmp_path / "config.json") in sentence


def test_a_step_is_named_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = load_train(["stage=s1"])
    (tmp_path / "config.json").write_text(json.dumps(to_dict(trained)))
    final = tmp_path / "policy.npz"
    before = saved(final)
    monkeypatch.setattr(export.checkpoint, "find", lambda run, step: ({}, step, []))
    monkeypatch.setattr(
        export,
        "write_policy",
        lambda path, leaves, trained, update, seed: saved(path, update=update),
    )
    assert export.main([f"run={tmp_path}", "step=100"]) == 0
    assert policy_file.read(tmp_path / "policy-step100.npz").meta["update"] == 100
    assert policy_file.read(final).digest == before.digest
    assert export.main([f"run={tmp_path}", "step=100", "format=c"]) == 0
    assert set(directory.visible(tmp_path)) == {
        "config.json", "policy.npz", "policy-step100.npz", "policy_c-step100"
    }  # fmt: skip


# Folders


def test_a_folder_is_replaced_only_as_it_was_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(tmp_path / "policy.npz")
    words, out = (f"policy={tmp_path / 'policy.npz'}", "format=c"), tmp_path / "policy_c"
    assert export.main(words) == 0
    first = _digests(out)
    (out / "build").mkdir()
    (out / "build" / "a.o").write_bytes(b"made of it")
    (out / "thesis.tex").write_bytes(b"mine")
    saved(tmp_path / "policy.npz", policies.arrays(seed=1))
    assert export.main(words) == 0
    second = _digests(out)
    assert first["policy.c"] != second["policy.c"]
    assert {"build/a.o", "thesis.tex"} < second.keys()
    (out / "Makefile").write_bytes(b"changed by hand")
    assert export.main(words) == 0
    assert _digests(out) == second
