"""Checks the bash, YAML and Dockerfile of launch/ without any cluster or cloud."""

import copy
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from swarmjax.run.load_settings import load_run
from swarmjax.run.settings import TrainConfig

ROOT = Path(__file__).parents[2]
LAUNCH = ROOT / "launch"
SCRIPTS = sorted(path for path in LAUNCH.iterdir() if path.suffix in (".sh", ".sbatch"))
DOCUMENTS = ("jobset", "skypilot")


def _read(name: str) -> Any:
    return yaml.safe_load((LAUNCH / f"{name}.yaml").read_text())


def _schema(name: str) -> jsonschema.Draft202012Validator:
    found = json.loads((Path(__file__).parent / f"{name}.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(found)
    return jsonschema.Draft202012Validator(found)


def _pod() -> Any:
    return _job()["template"]["spec"]


def _job() -> Any:
    return _read("jobset")["spec"]["replicatedJobs"][0]["template"]["spec"]


def _lint(*arguments: str, script: str | None = None) -> str:
    """Runs shellcheck and returns its findings."""
    command = [str(Path(sys.executable).with_name("shellcheck")), *arguments]
    done = subprocess.run(command, input=script, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_shellcheck_finds_nothing_in_a_script(script: Path) -> None:
    assert _lint(str(script)) == ""


def test_shellcheck_finds_nothing_in_the_bash_of_the_documents() -> None:
    task, (meet,) = _read("skypilot"), _pod()["initContainers"]
    assert _lint("--shell=bash", "-", script=task["run"]) == ""
    assert _lint("--shell=bash", "-", script=task["setup"]) == ""
    assert _lint("--shell=dash", "-", script=meet["args"][0]) == ""


def test_shellcheck_finds_what_is_wrong() -> None:
    assert "SC2086" in _lint("--shell=bash", "-", script="rm $1\n")


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_document_has_published_fields_alone(name: str) -> None:
    _schema(name).validate(_read(name))


@pytest.mark.parametrize(
    ("name", "place", "value"),
    [
        ("jobset", ["apiVersion"], "jobset.x-k8s.io/v1"),
        ("jobset", ["spec", "failurePolicy", "maxRestart"], 3),
        ("jobset", ["spec", "failurePolicy", "rules", 0, "action"], "Fail"),
        ("jobset", ["spec", "replicatedJobs", 0, "template", "spec", "parallelism"], "2"),
        ("skypilot", ["resources", "job_recovery", "recover_on_exit_codes"], [750]),
        ("skypilot", ["resources", "spot"], True),
        ("skypilot", ["file_mounts", "/runs", "mode"], "CACHED"),
    ],
)
def test_a_schema_refuses_what_is_not_published(name: str, place: list, value: object) -> None:
    document = copy.deepcopy(_read(name))
    *path, last = place
    inner = document
    for key in path:
        inner = inner[key]
    inner[last] = value
    with pytest.raises(jsonschema.ValidationError):
        _schema(name).validate(document)


def _command(container: dict) -> list[str]:
    """Substitutes the variables in a container's arguments, as Kubernetes does."""
    values = _variables(container)
    return [
        re.sub(r"\$\((\w+)\)", lambda found: values[found[1]], each) for each in container["args"]
    ]


def _variables(container: dict) -> dict[str, str]:
    return {each["name"]: each["value"] for each in container["env"] if "value" in each}


def test_the_pods_of_a_jobset_are_the_processes_of_one_run() -> None:
    job, (train,) = _job(), _pod()["containers"]
    settings, variables = load_run(_command(train)), _variables(train)
    assert settings.run.distributed
    assert settings.devices == int(variables["JAX_NUM_PROCESSES"]) == job["completions"]
    (index,) = (each for each in train["env"] if each["name"] == "JAX_PROCESS_ID")
    assert index["valueFrom"]["fieldRef"]["fieldPath"].endswith("job-completion-index']")
    name, (replicated,) = (
        _read("jobset")["metadata"]["name"],
        _read("jobset")["spec"]["replicatedJobs"],
    )
    host = f"{name}-{replicated['name']}-0-0.{name}"
    assert variables["JAX_COORDINATOR_ADDRESS"] == f"{host}:12355"
    assert train["resources"]["limits"]["nvidia.com/gpu"] == 1
    assert "command" not in train  # so the image's entry point runs, which is tested below
    assert _mounted(settings, [mount["mountPath"] for mount in train["volumeMounts"]])


def _mounted(settings: TrainConfig, paths: list[str]) -> bool:
    return any(Path(str(settings.run.dir)).is_relative_to(path) for path in paths)


def test_bad_settings_end_a_jobset_and_all_else_starts_it_again() -> None:
    job, policy = _job(), _read("jobset")["spec"]["failurePolicy"]
    (rule,) = job["podFailurePolicy"]["rules"]
    assert rule["action"] == "FailJob"
    assert rule["onExitCodes"] == {"containerName": "train", "operator": "In", "values": [1, 2]}
    assert [each["action"] for each in policy["rules"]] == ["FailJobSet"]
    assert policy["rules"][0]["onJobFailureReasons"] == ["PodFailurePolicy"]
    assert job["backoffLimit"] == 0
    assert policy["maxRestarts"] > 0


def test_pods_wait_for_each_other(tmp_path: Path) -> None:
    (meet,) = _pod()["initContainers"]
    (count,) = [each["value"] for each in meet["env"] if each["name"] == "PROCESSES"]
    assert int(count) == _job()["completions"] == 2
    script = meet["args"][0].replace("/runs/", f"{tmp_path}/")

    def start(index: int) -> subprocess.Popen[bytes]:
        given = {"JOB": "a", "PROCESSES": count, "JOB_COMPLETION_INDEX": str(index)}
        return subprocess.Popen([*meet["command"], script], env=os.environ | given)

    first = start(0)
    with pytest.raises(subprocess.TimeoutExpired):
        first.wait(timeout=2)
    assert start(1).wait(timeout=20) == 0
    assert first.wait(timeout=20) == 0


def test_the_nodes_of_a_cloud_are_the_processes_of_one_run(tmp_path: Path) -> None:
    task = _read("skypilot")
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    joined = "$JAX_COORDINATOR_ADDRESS $JAX_NUM_PROCESSES $JAX_PROCESS_ID"
    python.write_text(f'#!/bin/sh\necho "{joined}"\nfor word in "$@"; do echo "$word"; done\n')
    python.chmod(0o755)
    for rank in range(task["num_nodes"]):
        given = {
            **task["envs"],
            "SKYPILOT_NODE_IPS": "10.0.0.7\n10.0.0.8",
            "SKYPILOT_NODE_RANK": str(rank),
            "SKYPILOT_NUM_NODES": str(task["num_nodes"]),
            "SKYPILOT_NUM_GPUS_PER_NODE": "1",
        }
        told = subprocess.check_output(
            ["bash", "-c", task["run"]], cwd=tmp_path, env=os.environ | given, text=True
        )
        joined, module, name, *words = told.splitlines()
        assert joined == f"10.0.0.7:12355 2 {rank}"
        assert (module, name) == ("-m", "swarmjax.train")
        settings = load_run(words)
        assert (settings.run.distributed, settings.devices) == (True, 2)
        assert _mounted(settings, list(task["file_mounts"]))
    assert task["resources"]["job_recovery"]["recover_on_exit_codes"] == [75, 134]
    assert task["resources"]["job_recovery"]["max_restarts_on_errors"] == 0


def _dockerfile() -> list[tuple[str, str]]:
    """Returns the instructions of the Dockerfile, each with its arguments."""
    lines = (LAUNCH / "Dockerfile").read_text().splitlines()
    found = (line.partition(" ") for line in lines if line and not line.startswith("#"))
    return [(name, rest) for name, _, rest in found]


def _copied() -> list[tuple[str, str]]:
    """Returns the source and the destination of everything that the Dockerfile copies."""
    copies = [rest.split() for name, rest in _dockerfile() if name == "COPY"]
    return [(source, words[-1]) for words in copies for source in words[:-1]]


def test_an_image_begins_with_training_and_belongs_to_no_root() -> None:
    instructions = dict(_dockerfile())
    assert json.loads(instructions["ENTRYPOINT"]) == ["python", "-m", "swarmjax.train"]
    assert instructions["USER"].isdecimal()  # Kubernetes cannot tell if a user's name means root
    assert int(instructions["USER"]) == _pod()["securityContext"]["runAsUser"] > 0
    assert f"python:{(ROOT / '.python-version').read_text().strip()}-slim" == instructions["FROM"]


def test_what_an_image_copies_is_there_and_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    kept = {line.removeprefix("!") for line in ignored if line.startswith("!")}
    assert "*" in ignored
    assert kept == {source for source, _ in _copied()}
    assert all((ROOT / source).exists() for source in kept)


def test_what_an_image_copies_is_what_the_package_is_built_of(tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {"pyproject.toml", project["project"]["readme"], *project["project"]["license-files"]}
    assert {source for source, _ in _copied()} == needed | {
        *wheel["packages"],
        *wheel["force-include"],
    }
    for source, to in _copied():
        copy_of = tmp_path / to / (source if to == "./" else "")
        if (ROOT / source).is_dir():
            shutil.copytree(ROOT / source, copy_of, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / source, copy_of)
    code = (
        "import sys\n"
        "from swarmjax.run import load_settings\n"
        "load_settings.load_run(sys.argv[1:])\n"
        "print(load_settings.__file__)\n"
    )
    told = subprocess.run(
        [sys.executable, "-c", code, *_command(_pod()["containers"][0])],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.stdout.startswith(str(tmp_path)), told.stderr
