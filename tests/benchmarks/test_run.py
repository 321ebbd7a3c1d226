"""Tests suites of benchmarks: the runs that are left, and the results of processes."""

import importlib
import importlib.util
import json
import math
import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from sentences import refusal

from benchmarks import lines, peers, run
from benchmarks.lines import Line, Output
from benchmarks.run import ENTRIES, SUITES, SuiteEntry, SuiteRunConfig
from swarmjax.run.load_settings import load_train

ENTRY = SuiteEntry(name="e", run="m", over="arenas", values=(8, 4, 2), seconds=20.0)
ALONE = SuiteEntry(name="a", run="m", seconds=20.0)

Script = Callable[[str], None]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    """Returns a function that replaces benchmarks by a script; it gets the requested `values`."""

    def put(body: str) -> None:
        def command_line(entry: SuiteEntry, values: list[int]) -> list[str]:
            head = f"import json, os, sys, time\nvalues = {values!r}\n"
            head += "def say(**line): print(json.dumps(line), flush=True)\n"
            return [sys.executable, "-c", head + body]

        monkeypatch.setattr(run, "command_line", command_line)

    return put


def _run(entry: SuiteEntry, path: Path, seconds: float = math.inf) -> list[Line]:
    run.run_entry(entry, Output(path), time.monotonic() + seconds)
    return lines.read(path)


# --- suites


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=list(ENTRIES))
def test_an_entry_has_a_benchmark_that_takes_its_words(entry: SuiteEntry) -> None:
    module, *words = entry.run.split()
    assert any(entry in entries for entries in SUITES.values())
    assert (entry.over is None) == (not entry.values)
    if module == "steps_per_second":
        settings = load_train([*words, "stage=s6", f"arenas={entry.values[0]}"])
        assert settings.arenas == entry.values[0]
    else:
        assert importlib.util.find_spec(f"benchmarks.{module}") is not None
    for word in words:
        if word.startswith("who="):
            assert word.removeprefix("who=") in peers.PEERS


@pytest.mark.parametrize("who", list(peers.PEERS))
def test_a_peer_has_a_function(who: str) -> None:
    module = importlib.import_module(f"benchmarks.{peers.PEERS[who]}")
    assert callable(getattr(module, who))


def test_only_some_entries() -> None:
    chosen = SuiteRunConfig(suite="peers", out="x", only=("peer_vmas", "planar-warp"))
    assert [entry.name for entry in run.entries(chosen)] == ["planar-warp", "peer_vmas"]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"suite": "most", "out": "x"}, "suite is 'most': give one of quick, "),
        ({"suite": "peers", "out": "x", "only": ("no",)}, "only holds 'no': give any of planar"),
    ],
)
def test_settings_that_do_not_fit_are_refused(given: dict, expected: str) -> None:
    assert expected in refusal(lambda: SuiteRunConfig(**given))


# --- resuming


def test_what_is_left_of_an_entry() -> None:
    def line(**given: object) -> Line:
        return {"benchmark": "m.x", "entry": "e", **given}

    assert run.left(ENTRY, []) == [8, 4, 2]
    assert run.left(ENTRY, [line(arenas=4)]) == [8, 2]
    assert run.left(ENTRY, [line(arenas=4) | {"entry": "other"}]) == [8, 4, 2]
    failed = [line(arenas=8), line(arenas=4, failed="it died")]
    assert run.left(ENTRY, failed) == [4, 2]
    assert run.left(ENTRY, [*failed, line(arenas=4)]) == [2]  # a later result replaces a failure
    assert run.left(ALONE, []) == [None]
    assert run.left(ALONE, [line(entry="a", skipped="no peer")]) == [None]
    assert run.left(ALONE, [line(entry="a")]) == []


def test_the_command_of_a_process() -> None:
    entry = SuiteEntry(name="e", run="m a=1", over="arenas", values=(8, 4))
    assert run.command_line(entry, [8, 4])[1:] == ["-m", "benchmarks.m", "a=1", "arenas=8,4"]
    assert run.command_line(ALONE, [None])[1:] == ["-m", "benchmarks.m"]


def test_results_are_kept_and_not_run_again(tmp_path: Path, script: Script) -> None:
    script("print('noise')\nfor v in values: say(benchmark='m', arenas=int(v))")
    path = tmp_path / "new" / "out.jsonl"
    found = _run(ENTRY, path)
    assert [(line["arenas"], line["entry"]) for line in found] == [(8, "e"), (4, "e"), (2, "e")]
    script("raise SystemExit('it must not be run')")
    assert _run(ENTRY, path) == found


def test_a_process_that_dies_costs_one_value(tmp_path: Path, script: Script) -> None:
    script(
        "for v in values:\n"
        "    if v == 4: sys.exit('the card is full')\n"
        "    say(benchmark='m', arenas=int(v))"
    )
    first, failed, last = _run(ENTRY, tmp_path / "out.jsonl")
    assert (first["arenas"], last["arenas"]) == (8, 2)
    assert failed == {
        "benchmark": "m",
        "entry": "e",
        "failed": "exit code 1: the card is full",
        "arenas": 4,
    }


def test_a_silent_process_is_ended(tmp_path: Path, script: Script) -> None:
    script("time.sleep(60)")
    entry = SuiteEntry(name="a", run="m", seconds=0.2)
    (line,) = _run(entry, tmp_path / "out.jsonl")
    assert line["failed"] == "printed nothing for 0.2 s"


def test_the_end_of_the_time_is_no_failure(tmp_path: Path, script: Script) -> None:
    script("say(benchmark='m', arenas=int(values[0])); time.sleep(60)")
    (line,) = _run(ENTRY, tmp_path / "out.jsonl", seconds=2.0)
    assert line["arenas"] == 8
    assert run.left(ENTRY, [line]) == [4, 2]


def test_a_missing_peer_is_skipped_and_said(tmp_path: Path, script: Script) -> None:
    script("say(benchmark='m', skipped='it is not installed')")
    (line,) = _run(ENTRY, tmp_path / "out.jsonl")
    assert line["skipped"] == "it is not installed"


def test_a_file_of_something_else_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "thesis.txt"
    path.write_text("years of work")
    assert "holds no JSON lines: give another file" in refusal(Output, path)
    assert path.read_text() == "years of work"


def test_a_line_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "out.jsonl"
    path.write_text('{"a": 1}\n{"a"')
    assert lines.read(path) == [{"a": 1}]
    path.write_text('{"a": 1}\n{"a"\n')
    assert refusal(lines.read, path) == f"{path} in line 2 is not a JSON object: remove it."


# --- peers


@pytest.mark.filterwarnings("ignore:'benchmarks.peers' found in sys.modules")
def test_a_benchmark_without_its_peer_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr(sys, "argv", ["peers", "who=vmas", "arenas=4"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("benchmarks.peers", run_name="__main__")
    assert ended.value.code == 0
    line = json.loads(capsys.readouterr().out)
    assert line["skipped"].startswith("torch cannot be imported (")
    assert line["skipped"].endswith("): install benchmarks/torch-peers.txt.")


def test_words_of_a_peer() -> None:
    found, rest = lines.parse(peers.PeerConfig, ["arenas=8,16", "stage=s6", "robots=2"])
    assert (found.arenas, found.robots, rest) == ((8, 16), 2, ["stage=s6"])


def test_speeds_of_a_peer() -> None:
    asked = peers.PeerConfig(robots=5, steps=10)
    found = peers.speed(asked, 4, 2, [1.0, 0.5, 2.0])  # 40 arena steps in 1 s, the median
    assert (found["arena_steps_per_s"], found["robot_steps_per_s"]) == (40.0, 200.0)
    assert (found["physics_steps_per_s"], found["call_s"]) == (80.0, 1.0)
    assert found["calls_s"] == [1.0, 0.5, 2.0]
