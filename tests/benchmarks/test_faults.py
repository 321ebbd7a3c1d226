"""Checks that campaigns of faults resume where they stopped, and count the outcomes of trials."""

import contextlib
import json
import os
import socket
from pathlib import Path

import pytest
from sentences import refusal

from benchmarks import faults, faults_inputs, faults_policies, faults_shared
from benchmarks.faults import Campaign


def _tried(seed: int, folder: Path) -> dict[str, object]:
    assert not [*folder.iterdir()]
    return {"outcome": "odd" if seed % 2 else "even", "seconds": float(seed)}


@pytest.fixture
def campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(faults.CAMPAIGNS, "policies", Campaign(_tried, 4))


def _trials(out: Path) -> list[int]:
    return [json.loads(line)["trial"] for line in out.read_text().splitlines()]


@pytest.mark.usefixtures("campaign")
def test_a_campaign_goes_on_where_it_stopped(tmp_path: Path) -> None:
    out = tmp_path / "lines.jsonl"
    words = ["campaign=policies", f"out={out}"]
    assert faults.main([*words, "count=2"]) == 0
    with out.open("a") as file:
        file.write('{"campaign": "policies", "tri')  # the process was stopped while writing
    faults.main(words)
    assert _trials(out) == [0, 1, 2, 3]
    faults.main(words)
    assert _trials(out) == [0, 1, 2, 3]


@pytest.mark.usefixtures("campaign")
def test_another_seed_tries_others(tmp_path: Path) -> None:
    out = tmp_path / "lines.jsonl"
    for seed in (0, 1):
        faults.main(["campaign=policies", f"out={out}", "count=2", f"seed={seed}"])
    seconds = [json.loads(line)["seconds"] for line in out.read_text().splitlines()]
    assert seconds == [0, 1, 1_000_000, 1_000_001]


@pytest.mark.usefixtures("campaign")
def test_the_table_counts_outcomes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lines.jsonl"
    faults.main(["campaign=policies", f"out={out}"])
    capsys.readouterr()
    faults.main(["campaign=table", f"out={out}"])
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.endswith("| odd | 2 | seconds 3 |")


def test_a_campaign_that_does_not_exist_is_refused() -> None:
    sentence = refusal(faults.main, ["campaign=floods", "out=a"])
    assert sentence.startswith("campaign is 'floods': give one of kills, terms, ")


@pytest.mark.parametrize("kind", sorted(faults_policies.DAMAGE))
def test_damaged_policies_are_refused_or_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    damage = faults_policies.DAMAGE[kind]
    monkeypatch.setattr(faults_policies, "DAMAGE", {kind: damage})
    monkeypatch.setattr(faults_policies, "MOST_SECONDS", 10.0)  # the machine may be busy
    found = [faults_policies.trial(seed, tmp_path) for seed in range(5)]
    assert {row["outcome"] for row in found} <= {"refused", "accepted"}, found


def test_fuzzed_inputs_run_or_are_refused(tmp_path: Path) -> None:
    found = []
    for seed in range(1, 40):
        if seed % 10:  # every tenth trial would start a process
            folder = tmp_path / str(seed)
            folder.mkdir()
            found.append(faults_inputs.trial(seed, folder))
    assert {row["outcome"] for row in found} <= {"refused", "runs"}, found


def test_files_from_strangers_do_nothing_but_describe(tmp_path: Path) -> None:
    found = []
    for seed in range(1, 40):  # trial 0 would start a process
        folder = tmp_path / str(seed)
        folder.mkdir()
        found.append(faults_shared.trial(seed, folder))
    assert {row["outcome"] for row in found} <= {"refused", "runs"}, found


def test_the_watch_sees_what_a_file_must_not_do(tmp_path: Path) -> None:
    evil = tmp_path / "evil.py"
    evil.write_text("")
    with contextlib.chdir(tmp_path), faults_shared.watched(tmp_path) as seen:
        exec(compile("", str(evil), "exec"))
        Path("elsewhere").touch()
        Path("out").mkdir()  # allowed
        os.environ.get("SWARMJAX_SECRET")
        socket.getaddrinfo("127.0.0.1", 9)
    assert [line.split()[1] for line in seen] == ["IMPORT", "WRITE", "ENVIRONMENT", "SOCKET"]
