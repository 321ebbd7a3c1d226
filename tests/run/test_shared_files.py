"""Tests that files from somebody else are data: recipes, stages, robots, suites and run configs."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from sentences import refusal

from swarmjax.config import to_dict
from swarmjax.evaluate.suite_config import read_suite
from swarmjax.run.load_settings import load_resume, load_run, load_train, settle
from swarmjax.run.policy_export import policy_meta

STAGE = "robots: 2\nside: 1.0\n"
SUITE = "cells:\n- {name: one, stage: s1, levels: 2, seed: 1000001}\n"
# For each kind of file: a function that reads it, and its text.
KINDS = {
    "recipe": (lambda path: load_run([f"recipe={path}"]), "stage: s3\n"),
    "algo": (lambda path: load_run([f"algo={path}"]), "algo: {epochs: 2}\n"),
    "stage": (lambda path: load_run([f"stage={path}"]), STAGE),
    "robot": (lambda path: load_run([f"robot={path}"]), "body: planar\n"),
    "realism": (lambda path: load_run([f"realism={path}"]), "speed_noise: 0.1\n"),
    "suite": (lambda path: read_suite(str(path)), SUITE),
}


@pytest.fixture
def evil(tmp_path: Path) -> Path:
    """A file of extensions that leaves a mark when it runs."""
    path = tmp_path / "evil.py"
    path.write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\n")
    return path


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("extensions", "evil.py"),
        ("resume", "R"),
        ("resume", "auto"),
        ("init_from", "R"),
        ("run", "{dir: elsewhere}"),
        ("run.dir", "elsewhere"),
        ("run.distributed", "true"),
        ("devices", "2"),
        ("seeds_by", "cores"),
    ],
)
@pytest.mark.parametrize("kind", ["recipe", "algo"])
def test_a_recipe_sets_what_is_trained_and_nothing_else(
    tmp_path: Path, evil: Path, kind: str, key: str, value: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"{KINDS[kind][1]}{key}: {value.replace('evil.py', str(evil))}\n")
    said = refusal(KINDS[kind][0], path)
    assert said.startswith(
        f"{path}: {key} cannot be set in a file, which may set only stage, robot, "
    )
    assert said.endswith(f": give {key} on the command line.")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_sound_file_of_each_kind_is_read(tmp_path: Path, kind: str) -> None:
    read, text = KINDS[kind]
    (tmp_path / "mine.yaml").write_text(text)
    assert read(tmp_path / "mine.yaml")


@pytest.mark.parametrize("tag", ["!!timestamp 2020-01-01", "!!set {a}", "!!binary aGk=", "!!omap"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_tag_is_one_sentence(tmp_path: Path, kind: str, tag: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"{KINDS[kind][1]}name: {tag}\n")
    assert refusal(KINDS[kind][0], path).startswith(f"{path} cannot be read: remove the YAML tag '")


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("recipe", "curriculum: {mode: X}\n"),
        ("recipe", "task: {observations: X}\n"),
        ("algo", "curriculum: {mode: X}\nalgo: {epochs: 2}\n"),
        ("stage", f"{STAGE}level: X\n"),
        ("robot", "body: X\n"),
        ("realism", "infrared: X\n"),
        ("suite", SUITE.replace("one", "X")),
    ],
)
def test_a_file_does_not_read_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, text: str
) -> None:
    monkeypatch.setenv("SECRET", "swordfish")
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace("X", "'${oc.env:SECRET}'"))
    assert "is '${oc.env:SECRET}': give " in refusal(KINDS[kind][0], path)


@pytest.mark.parametrize("entries", [9_000, 60_000])
def test_many_entries_are_answered_at_once(tmp_path: Path, entries: int) -> None:
    path = tmp_path / "mine.yaml"
    extra = "".join(f"      a{number}: 1\n" for number in range(entries))
    path.write_text(f"task:\n  reward:\n    extra:\n{extra}")
    began = time.process_time()
    said = refusal(load_run, [f"recipe={path}"])
    assert "names 'a0'" in said or "has more than 10000 values" in said
    assert time.process_time() - began < 5.0


@pytest.mark.parametrize("kind", ["recipe", "suite"])
def test_a_stage_that_a_file_names_lies_beside_it(tmp_path: Path, kind: str) -> None:
    (tmp_path / "four.yaml").write_text("robots: 4\nside: 1.0\n")
    path = tmp_path / "mine.yaml"
    texts = {"recipe": "stage: four.yaml\n", "suite": SUITE.replace("s1", "four.yaml")}
    path.write_text(texts[kind])
    found = KINDS[kind][0](path)
    stage = found.stage[0] if kind == "recipe" else found.cells[0].stage
    assert (stage.name, stage.robots) == ("four", 4)


def test_a_recipe_beside_resume_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps(to_dict(load_train([]))))
    (tmp_path / "mine.yaml").write_text("algo: {discount: 0.5}\n")
    said = refusal(load_run, [f"recipe={tmp_path / 'mine.yaml'}", f"resume={tmp_path}"])
    assert "cannot be given: a resumed run keeps its settings" in said


# Runs and policies


def test_a_stored_run_does_not_name_code(tmp_path: Path, evil: Path) -> None:
    stored = to_dict(load_train([])) | {"extensions": str(evil)}
    assert load_resume(stored, []).extensions is None
    assert not (tmp_path / "ran").exists()


def test_a_run_with_an_extension_asks_for_it(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "from swarmjax.extension import reward_term\n\n\n"
        "@reward_term(weight=1.0)\ndef brave(step):\n    return step.distance\n"
    )
    trained = load_train([f"extensions={path}"])
    stored = to_dict(trained)
    assert "mine.py" not in json.dumps(stored)
    digest = trained.pieces["reward"]["brave"]
    assert refusal(load_resume, stored, []) == (
        f"the stored run was trained with the reward brave of digest {digest[:12]}, but extensions "
        "has no such piece: give extensions=FILE, the file of that training."
    )
    assert settle(load_resume(stored, [f"extensions={path}"])).extensions == str(path)


def test_a_policy_carries_no_path() -> None:
    words = ["run.dir=/far/away/runs/a", "run.wandb=mine", "resume=/far/away/b", "stage=s1"]
    meta = policy_meta(load_train(words), update=1, seed=0)
    assert not {"run", "resume", "init_from", "extensions"} & meta["config"].keys()
    assert "/far/away" not in json.dumps(meta, default=np.ndarray.tolist)
