"""Checks `swarmjax.report` by its command line."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from runs import row, write

from swarmjax import command
from swarmjax.report import __main__ as report
from swarmjax.report.config import ReportConfig
from swarmjax.run import directory


def _run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["report", *words])
    return command.run("report", report.main, ReportConfig)


def test_a_report_is_written_beside_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write(tmp_path / "a 'run'", [row(0)])
    assert _run(monkeypatch, f"run={str(run)!r}") == 0
    out = run / "report"
    assert set(directory.visible(out)) == {"success.png", "stages.png", "mix.png", "report.html"}
    page = (out / "report.html").read_text()
    assert f"<h1>Report of {tmp_path}/a &#39;run&#39;</h1>" in page
    assert "<code>python -m swarmjax.report &#39;run=" in page
    assert str(out / "report.html") in capsys.readouterr().out


def test_a_report_links_to_the_replay_of_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write(tmp_path, [row(0)])
    (run / "replay.html").touch()
    assert _run(monkeypatch, f"run={run}") == 0
    assert '<a href="../replay.html">' in (run / "report" / "report.html").read_text()


def test_a_report_is_written_where_it_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out = write(tmp_path / "run", [row(0)]), tmp_path / "deep" / "out"
    assert _run(monkeypatch, f"run={run}", f"out={out}") == 0
    assert (out / "report.html").exists()
    assert not (run / "report").exists()
    first = (out / "report.html").read_bytes()
    assert _run(monkeypatch, f"run={run}", f"out={out}") == 0
    assert (out / "report.html").read_bytes() == first


def test_a_report_of_a_run_that_was_killed_leaves_its_unfinished_line_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out = write(tmp_path / "run", [row(0), row(1)]), tmp_path / "out"
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps(row(2))[:-20])
    assert _run(monkeypatch, f"run={run}", f"out={out}") == 0
    assert "2 of 20 updates" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["run=gone"], "gone is not a run directory: it has no config.json."),
        (["run=cut"], "cut/metrics.jsonl in line 1 is damaged: resume the run, or remove"),
        (["run=text"], "text/metrics.jsonl in line 1 has no number as train_s: it is damaged."),
        (["run=empty"], "empty/metrics.jsonl has no update that every seed recorded: train first."),
        (["run=good", "out=file"], "out is file, which cannot be written: File exists."),
        ([], "run is missing: give run=DIR, or runs=DIR,DIR,... to compare."),
        (
            ["run=good", "runs=good"],
            "run and runs are given: give run=DIR, or runs=DIR,DIR,... to",
        ),
        (["run=good", "step=1"], "step is not a key: give one of run, runs, out."),
        (["runs=good,gone"], "runs is 'good,gone', but 'gone' names neither a run nor a "),
        (["runs=good,good"], "good and good have the same settings and share a seed: "),
        (["runs=good,,cut"], "runs is 'good,,cut', but '' names neither a run nor a "),
        (["runs=good,same"], "good and same have the same settings and share a seed: "),
        (
            ["runs=good,empty"],
            "empty/metrics.jsonl has no update that every seed recorded: train first.",
        ),
        (["runs=good", "out=file"], "out is file, which cannot be written: File exists."),
    ],
)
def test_errors_are_one_sentence(
    words: list[str],
    what: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    text = [row(0, train_s="1")]
    for name, rows in {"good": [row(0)], "same": [row(0)], "empty": [], "text": text}.items():
        write(Path(name), rows)
    good = (write(Path("cut"), [row(0)]) / "metrics.jsonl").read_text()
    Path("cut/metrics.jsonl").write_text(good[:-20] + "\n" + good)
    Path("file").write_text("")
    assert _run(monkeypatch, *words) == 2
    sentence = capsys.readouterr().err
    assert sentence.startswith(f"swarmjax.report: error: {what}")
    assert sentence.count("\n") == 1


def test_matplotlib_is_loaded_to_draw_only_and_jax_never(tmp_path: Path) -> None:
    run = write(tmp_path, [row(0)])
    code = (
        "import sys\n"
        "from swarmjax.report import __main__ as report\n"
        "from swarmjax.run import display, recorder\n"
        "assert 'matplotlib' not in sys.modules\n"
        f"report.main(['run={run}'])\n"
        "assert 'matplotlib' in sys.modules\n"
        "assert 'jax' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
