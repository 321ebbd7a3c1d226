"""Tests suites of benchmarks: the runs that are left, the results of processes, and the page."""

import importlib.util
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from sentences import refusal

from benchmarks import key_value, peers, robots_speed, run, run_page, run_tables, steps_per_second
from benchmarks.run import Line, Output, SuiteEntry, SuiteRunConfig
from benchmarks.suites import SUITES
from swarmjax.run.load_settings import load_train

ENTRY = SuiteEntry(name="e", module="m", over="arenas", values=("8", "4", "2"), seconds=20.0)
ALONE = SuiteEntry(name="a", module="m", seconds=20.0)

Script = Callable[[str], None]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    """Returns a function that replaces benchmarks by a script; it gets the requested `values`."""

    def put(body: str) -> None:
        def command_line(entry: SuiteEntry, values: list[str]) -> list[str]:
            head = f"import json, os, sys, time\nvalues = {values!r}\n"
            head += "def say(**line): print(json.dumps(line), flush=True)\n"
            return [sys.executable, "-c", head + body]

        monkeypatch.setattr(run, "command_line", command_line)

    return put


def _run(entry: SuiteEntry, path: Path, seconds: float = math.inf) -> list[Line]:
    run.run_entry(entry, Output(path), time.monotonic() + seconds)
    return run.read(path)


# --- suites


@pytest.mark.parametrize("suite", list(SUITES))
def test_entries_of_a_suite_have_names_of_their_own_and_a_benchmark(suite: str) -> None:
    entries = SUITES[suite]
    assert len({entry.name for entry in entries}) == len(entries)
    for entry in entries:
        assert importlib.util.find_spec(f"benchmarks.{entry.module}") is not None
        assert (entry.over is None) == (entry.values == ())


def test_an_entry_of_a_name_is_the_same_in_all_suites() -> None:
    found: dict[str, SuiteEntry] = {}
    for entries in SUITES.values():
        for entry in entries:
            assert found.setdefault(entry.name, entry) == entry


def test_words_of_training_are_taken() -> None:
    for entry in SUITES["gpu"] + SUITES["cpu"]:
        if entry.module == "steps_per_second":
            settings = load_train([*entry.words, "stage=s6", f"arenas={entry.values[0]}"])
            assert settings.arenas == int(entry.values[0])


def test_only_some_entries() -> None:
    chosen = SuiteRunConfig(suite="peers", out="x", only=("peer_vmas", "planar-warp"))
    assert [entry.name for entry in run.entries(chosen)] == ["planar-warp", "peer_vmas"]
    assert run.entries(SuiteRunConfig(table="x", docs="y")) == []


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"suite": "most", "out": "x"}, "suite is 'most': give one of quick, "),
        ({"suite": "quick"}, "out is null"),
        ({}, "suite is null"),
        ({"suite": "peers", "out": "x", "only": ("no",)}, "only holds 'no': give any of planar"),
        ({"suite": "quick", "out": "x", "table": "y"}, "docs is null"),
    ],
)
def test_settings_that_do_not_fit_are_refused(given: dict, expected: str) -> None:
    assert expected in refusal(lambda: SuiteRunConfig(**given))


# --- resuming


def test_what_is_left_of_an_entry() -> None:
    def line(**given: object) -> Line:
        return {"benchmark": "m.x", "entry": "e", **given}

    assert run.left(ENTRY, []) == ["8", "4", "2"]
    assert run.left(ENTRY, [line(arenas=4)]) == ["8", "2"]
    assert run.left(ENTRY, [line(arenas=4) | {"entry": "other"}]) == ["8", "4", "2"]
    failed = [line(arenas=8), line(arenas="4", failed="it died")]
    assert run.left(ENTRY, failed) == ["4", "2"]
    assert run.left(ENTRY, [*failed, line(arenas=4)]) == ["2"]  # a later result replaces a failure
    assert run.left(ALONE, []) == [None]
    assert run.left(ALONE, [line(entry="a", skipped="no peer")]) == [None]
    assert run.left(ALONE, [line(entry="a")]) == []


def test_the_command_of_a_process() -> None:
    entry = SuiteEntry(name="e", module="m", words=("a=1",), over="arenas", values=("8", "4"))
    assert run.command_line(entry, ["8", "4"])[1:] == ["-m", "benchmarks.m", "a=1", "arenas=8,4"]
    assert run.command_line(ALONE, [None])[1:] == ["-m", "benchmarks.m"]


def test_results_are_kept_and_not_run_again(tmp_path: Path, script: Script) -> None:
    script("print('noise')\nfor v in values: say(benchmark='m', arenas=int(v))")
    path = tmp_path / "new" / "out.jsonl"
    lines = _run(ENTRY, path)
    assert [(line["arenas"], line["entry"]) for line in lines] == [(8, "e"), (4, "e"), (2, "e")]
    script("raise SystemExit('it must not be run')")
    assert _run(ENTRY, path) == lines


def test_a_process_that_dies_costs_one_value(tmp_path: Path, script: Script) -> None:
    script(
        "for v in values:\n"
        "    if v == '4': sys.exit('the card is full')\n"
        "    say(benchmark='m', arenas=int(v))"
    )
    first, failed, last = _run(ENTRY, tmp_path / "out.jsonl")
    assert (first["arenas"], last["arenas"]) == (8, 2)
    assert failed == {
        "benchmark": "m",
        "entry": "e",
        "failed": "exit code 1: the card is full",
        "arenas": "4",
    }


def test_a_silent_process_is_ended(tmp_path: Path, script: Script) -> None:
    script("time.sleep(60)")
    entry = SuiteEntry(name="a", module="m", seconds=0.2)
    (line,) = _run(entry, tmp_path / "out.jsonl")
    assert line["failed"] == "printed nothing for 0.2 s"


def test_the_end_of_the_time_is_no_failure(tmp_path: Path, script: Script) -> None:
    script("say(benchmark='m', arenas=int(values[0])); time.sleep(60)")
    (line,) = _run(ENTRY, tmp_path / "out.jsonl", seconds=2.0)
    assert line["arenas"] == 8
    assert run.left(ENTRY, [line]) == ["4", "2"]


def test_a_missing_peer_is_skipped_and_said(tmp_path: Path, script: Script) -> None:
    script("say(benchmark='m', skipped='it is not installed')")
    (line,) = _run(ENTRY, tmp_path / "out.jsonl")
    assert line["skipped"] == "it is not installed"


def test_each_value_may_have_a_process_of_its_own(tmp_path: Path, script: Script) -> None:
    script("say(benchmark='m', arenas=int(values[0]), asked=len(values))")
    entry = SuiteEntry(name="e", module="m", over="arenas", values=("8", "4"), each=1, seconds=20.0)
    lines = _run(entry, tmp_path / "out.jsonl")
    assert [(line["arenas"], line["asked"]) for line in lines] == [(8, 1), (4, 1)]


def test_a_line_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "out.jsonl"
    path.write_text('{"a": 1}\n{"a"')
    assert run.read(path) == [{"a": 1}]
    path.write_text('{"a": 1}\n{"a"\n')
    assert refusal(run.read, path) == f"{path} in line 2 is not JSON: remove it."


# --- peers


def test_a_benchmark_without_its_peer_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["peer"])
    code = peers.run("peer", lambda _: peers.find("no_such_peer", "some"), peers.PeerConfig)
    assert code == 0
    assert json.loads(capsys.readouterr().out) == {
        "benchmark": "peer",
        "skipped": "no_such_peer cannot be imported (No module named 'no_such_peer'): install "
        "some.",
    }


def test_words_of_a_peer() -> None:
    found, rest = key_value.parse(peers.PeerConfig, ["arenas=8,16", "stage=s6", "robots=2"])
    assert (found.arenas, found.robots, rest) == ((8, 16), 2, ["stage=s6"])


def test_speeds_of_a_peer() -> None:
    asked = peers.PeerConfig(robots=5, steps=10)
    found = peers.speed(asked, 4, 2, [1.0, 0.5, 2.0])  # 40 arena steps in 1 s, the median
    assert (found["arena_steps_per_s"], found["robot_steps_per_s"]) == (40.0, 200.0)
    assert (found["physics_steps_per_s"], found["call_s"]) == (80.0, 1.0)
    assert found["calls_s"] == [1.0, 0.5, 2.0]


# --- sizes


def test_robots_share_the_floor_and_the_card() -> None:
    made = robots_speed.load(20, 1000, [])
    (stage,) = made.stage
    # 1000 / 20 = 50 arenas are closer to 64 than to 32 by the logarithm. The side is
    # 1.2 m * sqrt(20 / 5).
    assert (made.arenas, stage.robots, stage.side, made.sim.max_robots) == (64, 20, 2.4, 20)
    (stage,) = robots_speed.load(1, 1000, []).stage
    assert stage.side == 0.8


def test_values_are_taken_out_of_words() -> None:
    words = ["arenas=1", "stage=s6", "arenas=8,16"]
    assert steps_per_second.split(words, "arenas") == (["8", "16"], ["stage=s6"])
    assert steps_per_second.split(["a=1"], "arenas") == ([], ["a=1"])


# --- the page


def _speed(arenas: int, robots_per_s: float, **given: object) -> Line:
    return {
        "benchmark": "steps_per_second.environment",
        "entry": "planar",
        "robot": "planar",
        "impl": "warp",
        "arenas": arenas,
        "robots": 5,
        "robot_steps_per_s": robots_per_s,
        "compile_s": 4.25,
        "program_bytes": 2048 * arenas,
        "call_s": 1.0,
        "calls_s": [1.0, 0.5, 2.0],
        "device": "1 x Card",
        "commit": "abc",
        "step": "a step",
        "substeps": 1,
        **given,
    }


PEER = _speed(256, 999.0, benchmark="peer_x.environment", entry="x", peer="X")


def test_the_newest_result_counts() -> None:
    old, new = _speed(256, 1.0), _speed(256, 2.0)
    other = _speed(1024, 3.0)
    failed = {"benchmark": "b", "entry": "planar", "arenas": "256", "failed": "it died"}
    assert run_tables.newest([old, other, new, failed]) == [new, other]


def test_what_failed_and_was_not_mended_is_told() -> None:
    failed = {"benchmark": "b", "entry": "planar", "arenas": "256", "failed": "it died"}
    skipped = {"benchmark": "peer_x", "entry": "x", "skipped": "not there"}
    assert run_tables.missing([failed, _speed(1024, 3.0), skipped]) == [failed, skipped]
    assert run_tables.missing([failed, _speed(256, 3.0), skipped, PEER]) == []


def test_tables() -> None:
    failed = {"benchmark": "b", "entry": "planar", "arenas": "64", "failed": "it died"}
    lines = [_speed(256, 1.5e6), _speed(1024, 61.23e6), _speed(4096, 1.234e9), PEER, failed]
    text = run_tables.markdown(lines)
    assert text.startswith("### 1 x Card\n\nCommits: `abc`.\n")
    assert (
        "| arenas | 256 | 1,024 | 4,096 |\n| --- | --: | --: | --: |\n"
        "| swarmjax, planar, warp | 1.5 M | 61.2 M | 1.23 G |\n| X | 999 |  |  |\n"
    ) in text
    # 2048 bytes per arena are shown as 2 KiB.
    assert (
        "| swarmjax, planar, warp: environment | 4.2 s, 2 KiB | 4.2 s, 2 KiB | 4.2 s, 2 KiB |"
        in text
    )
    assert "| X | a step | 1 |" in text
    assert text.endswith("### Without a result\n\n- planar (arenas=64): failed: it died\n")


def test_trainers_and_seeds() -> None:
    trainer = {
        "benchmark": "race",
        "entry": "r",
        "trainer": "T",
        "arenas": 8,
        "transitions_per_s": 2500.0,
        "arena_steps_per_s": 500.0,
        "compile_s": None,
        "seconds_to_0.90": 1.25,
        "seconds_to_0.95": None,
        "device": "d",
        "commit": "c",
    }
    seeded = [trainer | {"seed": seed, "seconds_to_0.90": 1.25 + seed} for seed in range(3)]
    text = run_tables.markdown(seeded)
    row = "| T | 8 | 3 | 2.5 k | 500 | - | 2.25 (1.25, 2.25, 3.25) | - (-, -, -) |"
    assert row in text
    seeds = [
        _speed(8, 0.0)
        | {"benchmark": "command_to_success", "seed": seed, "judged": 0.96, "saved_s": 9.0}
        | {"seconds_to_0.90": float(seed), "seconds_to_0.95": None if seed else 4.0}
        for seed in range(3)
    ]
    text = run_tables.markdown(seeds)
    # A seed that never reached 0.95 counts as slower than all that did. Two of three seeds never
    # reached it, so there is no median.
    row = "| swarmjax, planar, warp | 3 | 1.0 (0.0, 1.0, 2.0) | - (4.0, -, -) "
    assert f"{row}| 9.0 (9.0, 9.0, 9.0) | 0.960, 0.960, 0.960 |" in text


def test_the_page_gets_tables_and_plots(tmp_path: Path) -> None:
    page = tmp_path / run_page.PAGE
    page.write_text("above\n<!-- results -->\nold\n<!-- /results -->\nbelow\n")
    run_page.write(tmp_path, [_speed(256, 1.5e6), _speed(1024, 6e6), PEER], Path("r.jsonl"))
    text = page.read_text()
    assert text.startswith("above\n")
    assert text.endswith("below\n")
    assert "old" not in text
    assert "Written by `benchmarks.run` from `r.jsonl`." in text
    plot = "figures/benchmarks_environment_1-x-card.png"
    assert f"]({plot})" in text
    assert (tmp_path / plot).stat().st_size > 1000
    page.unlink()
    assert "cannot be used" in refusal(run_page.write, tmp_path, [], Path("r.jsonl"))
