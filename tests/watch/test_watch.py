"""Tests the answers of the server of a run's page, and what it reports about the run."""

import http.client
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from runs import CONFIG, row, write

from swarmjax import command
from swarmjax.config.section import ByName
from swarmjax.report import figures, rows
from swarmjax.run import directory
from swarmjax.run.settings import RunConfig
from swarmjax.watch import __main__ as watch
from swarmjax.watch import live_page, status
from swarmjax.watch.config import WatchConfig
from swarmjax.watch.live_page import LivePage
from swarmjax.watch.server import Server

UPDATES = CONFIG.updates


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("runs") / "a <b>", [row(0), row(1)])


@pytest.fixture(scope="module")
def server(run: Path) -> Iterator[Server]:
    with Server(0, LivePage(run)) as made:
        threading.Thread(target=made.serve_forever, daemon=True).start()
        yield made
        made.shutdown()


def _ask(
    server: Server, path: str, method: str = "GET", host: str | None = None
) -> tuple[int, dict[str, str], bytes]:
    """Sends a request with any text as path and host; returns status, headers and content."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.putrequest(method, path, skip_host=True)
    if host != "":
        connection.putheader("Host", host or f"127.0.0.1:{server.server_port}")
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return found


def test_it_listens_on_the_loopback_alone(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize("path", ["/", "/?a=b"])
def test_the_page_is_answered_and_not_kept(server: Server, path: str) -> None:
    status, headers, content = _ask(server, path)
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert headers["Refresh"] == "5"
    page = content.decode()
    assert "It has stopped after 2 of 20 updates." in page
    assert 'id="success"' in page
    assert "<script" not in page


@pytest.mark.parametrize(
    "path",
    [
        "/config.json",
        "/../config.json",
        "/figures/../config.json",
        "/figures/..%2fconfig.json",
        "/%2e%2e/config.json",
        "//etc/passwd",
        "/figures/../../../../etc/passwd.png",
        "http://127.0.0.1/",
        "*",
    ],
)
def test_no_path_leads_elsewhere(server: Server, path: str) -> None:
    status, _, content = _ask(server, path)
    assert (status, content) == (404, b"There is no such page.\n")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "", "[::1]:{port}"]
)
def test_a_request_that_was_meant_for_another_host_is_refused(server: Server, host: str) -> None:
    host = host.format(port=server.server_port)
    assert _ask(server, "/", host=host)[0] == 421


def test_localhost_is_this_machine(server: Server) -> None:
    assert _ask(server, "/", host=f"localhost:{server.server_port}")[0] == 200


@pytest.mark.parametrize("method", ["HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"])
def test_it_is_read_and_nothing_else(server: Server, method: str) -> None:
    assert _ask(server, "/", method)[0] == 501


def test_the_name_of_a_run_is_text(server: Server) -> None:
    content = _ask(server, "/")[2].decode()
    assert "a &lt;b&gt;" in content
    assert "a <b>" not in content


def test_a_run_without_an_update_has_a_page(tmp_path: Path) -> None:
    page = LivePage(write(tmp_path / "run", []))
    assert "It has stopped after 0 of 20 updates." in page.html()


def test_a_run_of_one_stage_has_no_panel_of_a_curriculum(tmp_path: Path) -> None:
    short = {key: value[:1] for key, value in row(0).items() if isinstance(value, list)}
    trained = replace(CONFIG, stage=CONFIG.stage[:1], stage_name="")
    page = LivePage(write(tmp_path / "run", [row(0) | short], trained=trained)).html()
    assert 'id="success"' in page
    assert 'id="mix"' not in page


def test_the_page_says_how_to_see_the_robots(tmp_path: Path) -> None:
    run = write(tmp_path / "run", [row(0)])
    (run / "policy.npz").touch()
    assert f"<code>python -m swarmjax.replay policy={run}/policy.npz" in LivePage(run).html()


def test_figures_are_drawn_anew_when_there_is_more_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []
    monkeypatch.setattr(figures, "png_files", lambda h: drawn.append(len(h.updates)) or {})
    monkeypatch.setattr(live_page, "SHARE", 1.0)  # never rests
    page = LivePage(write(tmp_path / "run", [row(0)]))
    page.html()
    page.html()
    write(page.run, [row(0), row(1)])
    with (page.run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps(row(2))[:40])  # half written
    page.html()
    assert drawn == [1, 2]
    assert page.trouble == ""


def test_a_damaged_line_is_told_and_what_was_drawn_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "SHARE", 1.0)  # never rests
    page = LivePage(write(tmp_path / "run", [row(0)]))
    page.html()
    with (page.run / "metrics.jsonl").open("a") as file:
        file.write("{}\n")
    assert "in line 2" in page.html()
    assert "success" in page.figures


# How a run stands


def _state(run: Path) -> tuple[str, str]:
    is_logged = (run / directory.METRICS).stat().st_size
    return status.read(run, CONFIG, rows.read(run) if is_logged else None)


def test_a_run_whose_lock_is_held_trains(tmp_path: Path) -> None:
    run = write(tmp_path / "run", [row(0), row(1)])
    with directory.locked(run):
        state, sentence = _state(run)
    assert state == "trains"
    # Two updates took 60 s of training, and 18 updates are left.
    assert "It trains: 2 of 20 updates done, about 9 min 00 s left." in sentence


def test_a_run_that_trains_and_has_written_nothing_says_so(tmp_path: Path) -> None:
    run = write(tmp_path / "run", [])
    with directory.locked(run):
        assert _state(run)[1] == "It trains: 0 of 20 updates done."


def test_a_run_whose_process_was_killed_says_so(tmp_path: Path) -> None:
    run = write(tmp_path / "run", [row(0)])
    code = "import pathlib, sys, time\nfrom swarmjax.run import directory\n"
    code += (
        "with directory.locked(pathlib.Path(sys.argv[1])):\n print(flush=True)\n time.sleep(600)"
    )
    words = [sys.executable, "-c", code, str(run)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        assert _state(run)[0] == "trains"
        holder.kill()
    state, sentence = _state(run)
    assert state == "stopped"
    assert sentence.startswith("It has stopped after 1 of 20 updates. ")
    assert sentence.endswith(f"Go on with: python -m swarmjax.train resume={run}")


def test_the_number_of_a_dead_process_that_another_has_by_now_is_not_it(tmp_path: Path) -> None:
    run = write(tmp_path / "run", [row(0)])
    with directory.locked(run):
        pass
    (run / ".lock").write_text(f"process {os.getpid()}\n")  # this process holds no lock
    assert _state(run)[0] == "stopped"


def test_a_run_whose_budget_is_spent_has_ended(tmp_path: Path) -> None:
    run = write(tmp_path / "run", [row(update) for update in range(UPDATES)])
    assert _state(run) == ("ended", "It has ended: 20 of 20 updates done.")


@pytest.mark.parametrize(
    ("updates", "goal", "state"), [(2, 0.9, "ended"), (1, 0.9, "stopped"), (2, 0.95, "stopped")]
)
def test_a_run_that_has_reached_its_success_has_ended(
    updates: int, goal: float, state: str, tmp_path: Path
) -> None:
    """A resumed run that asks for more, or has gone on, has not ended by its old summary."""
    trained = replace(CONFIG, run=RunConfig(stop_at=goal))
    run = write(tmp_path / "run", [row(0), row(1)], trained=trained)
    (run / "summary.json").write_text(json.dumps({"updates": updates, "stopped_at": 0.9}))
    assert _state(run)[0] == state
    if state == "ended":
        assert _state(run)[1] == "It has ended: 2 of 20 updates done, run.stop_at is reached."


@pytest.mark.parametrize(("age", "state"), [(0, "trains"), (1000, "stopped")])
def test_a_run_on_another_machine_is_judged_by_what_it_writes(
    tmp_path: Path, age: int, state: str
) -> None:
    run = write(tmp_path / "run", [row(0)])
    (run / ".lock").write_text("process 1\nnode7\n")
    then = (run / "metrics.jsonl").stat().st_mtime - age
    os.utime(run / "metrics.jsonl", (then, then))
    assert _state(run)[0] == state


@pytest.mark.parametrize(
    ("process", "is_written"),
    [(os.getpid(), True), (2**22 + 1, False), (2**70, False)],
    ids=["own", "too large", "far too large"],  # the same in every test process
)  # the second is above Linux's largest process number
def test_a_process_that_has_ended_is_not_writing(
    tmp_path: Path, process: int, *, is_written: bool
) -> None:
    (tmp_path / ".lock").write_text(f"process {process}\n{socket.gethostname()}\n")
    assert directory.is_written(tmp_path) is is_written


def test_code_that_a_run_names_is_not_run(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    own = tmp_path / "own.py"
    own.write_text(f"open({str(mark)!r}, 'w')\n")
    pieces = ByName({"reward": ByName({"mine": "0" * 64})})
    run = write(tmp_path / "run", [row(0)], trained=replace(CONFIG, pieces=pieces))
    stored = json.loads((run / "config.json").read_text()) | {"extensions": str(own)}
    (run / "config.json").write_text(json.dumps(stored))
    LivePage(run).html()
    assert not mark.exists()


# The command


def _command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["watch", *words])
    return command.run("watch", watch.main, WatchConfig)


def test_a_folder_that_is_no_run_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _command(monkeypatch, f"run={tmp_path}") == 2
    said = capsys.readouterr().err
    assert said.endswith(f"{tmp_path} is not a run directory: it has no config.json.\n")
    assert said.count("\n") == 1


def test_a_port_that_is_taken_is_one_sentence(
    server: Server, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _command(monkeypatch, f"run={str(run)!r}", f"port={server.server_port}") == 2
    assert f"port is {server.server_port}, which is not available" in capsys.readouterr().err


def test_control_c_ends_it(run: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    def interrupted(server: Server) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Server, "serve_forever", interrupted)
    assert _command(monkeypatch, f"run={str(run)!r}") == 130
    assert capsys.readouterr().out.startswith("http://127.0.0.1:")
