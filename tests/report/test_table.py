"""Checks the table of several runs."""

import dataclasses
from pathlib import Path

import pytest
from runs import CONFIG, row, write

from swarmjax.config.section import ByName
from swarmjax.report import __main__ as report
from swarmjax.report import table
from swarmjax.run.settings import RunConfig, TrainConfig

MORE = dataclasses.replace(CONFIG, algo=dataclasses.replace(CONFIG.algo, epochs=3))


def _rows(*success: float | None, first: int = 0) -> list[dict]:
    """Returns two updates for each seed; the second has the seed's success on the last stage."""
    return [
        row(update, first + seed, success_by_stage=[0.9, each if update else None])
        for update in (0, 1)
        for seed, each in enumerate(success)
    ]


def _lines(runs: list[Path]) -> list[table.TableLine]:
    return [group.line for group in table.read(runs)]


def _array(folder: Path, jobs: list[list[float]], trained: TrainConfig = CONFIG) -> Path:
    """Writes the runs of an array of jobs, each with its own seeds and its own folder."""
    for job, success in enumerate(jobs):
        first = job * len(success)
        config = dataclasses.replace(
            trained, seed=first, seeds=len(success), run=RunConfig(dir=str(folder / str(job)))
        )
        write(folder / str(job), _rows(*success, first=first), trained=config)
    return folder


def test_seeds_of_an_array_are_one_line(tmp_path: Path) -> None:
    folder = _array(tmp_path / "mine", [[0.5, 0.6], [0.7, 0.8], [0.9, 1.0]])
    (line,) = _lines(table.find(str(folder)))
    assert line.seeds == [0, 1, 2, 3, 4, 5]
    assert line.success == pytest.approx([0.5, 0.6, 0.7, 0.8, 0.9, 1.0], rel=1e-6)
    assert line.mean == pytest.approx(0.75)
    assert line.interval is not None
    low, high = line.interval
    assert 0.5 < low < 0.75 < high < 1.0
    assert line.train_s == 180.0
    assert (line.updates, line.budget) == (2, 20)
    assert line.stage == "trio"
    assert line.settings == ""


def test_seeds_on_devices_are_counted_with_seeds_of_one_device(tmp_path: Path) -> None:
    _array(tmp_path / "one", [[0.5, 0.6]])
    spread = dataclasses.replace(CONFIG, seed=2, seeds=2, devices=2, seeds_by="devices")
    write(tmp_path / "two", _rows(0.7, 0.8, first=2), trained=spread)
    (line,) = _lines(table.find(f"{tmp_path}/one,{tmp_path}/two"))
    assert line.seeds == [0, 1, 2, 3]


def test_jobs_given_by_relative_and_absolute_paths_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _array(tmp_path, [[0.5], [0.6]])
    monkeypatch.chdir(tmp_path)
    (line,) = _lines(table.find(f"0,{tmp_path}/1"))
    assert table.cells(line)[-1] == f"2 in {tmp_path}"


def test_cells_of_a_sweep_are_a_line_each(tmp_path: Path) -> None:
    for cell, trained in {"a": CONFIG, "b": MORE}.items():
        write(tmp_path / cell, _rows(0.5, 0.6), trained=dataclasses.replace(trained, seeds=2))
    lines = _lines(table.find(str(tmp_path)))
    assert [line.settings for line in lines] == ["algo.epochs=1", "algo.epochs=3"]
    assert [line.interval for line in lines] == [None, None]


def test_stages_are_told_apart_by_their_name(tmp_path: Path) -> None:
    pair = dataclasses.replace(CONFIG, stage=CONFIG.stage[:1], stage_name="")
    write(tmp_path / "a", [row(0)])
    short = ("mix", "weights", *(key for key in row(0) if key.endswith("_by_stage")))
    write(tmp_path / "b", [row(0) | {key: row(0)[key][:1] for key in short}], trained=pair)
    lines = _lines(table.find(str(tmp_path)))
    assert [line.settings for line in lines] == ["stage=pair-trio", "stage=pair"]


def test_runs_of_other_budgets_are_not_one_line(tmp_path: Path) -> None:
    write(tmp_path / "a", _rows(0.5))
    longer = dataclasses.replace(CONFIG, budget=2 * CONFIG.budget, seed=1)
    write(tmp_path / "b", _rows(0.6, first=1), trained=longer)
    lines = _lines(table.find(str(tmp_path)))
    assert [line.settings for line in lines] == ["budget=1280", "budget=2560"]


def test_runs_that_stop_at_other_successes_are_not_one_line(tmp_path: Path) -> None:
    goal = dataclasses.replace(CONFIG, run=RunConfig(stop_at=0.9))
    runs = [write(tmp_path / "a", _rows(0.5)), write(tmp_path / "b", _rows(0.9), trained=goal)]
    assert [group.line.settings for group in table.read(runs)] == [
        "run.stop_at=null",
        "run.stop_at=0.9",
    ]


def test_runs_of_a_folder_and_of_its_subfolders_are_taken(tmp_path: Path) -> None:
    _array(tmp_path / "mine", [[0.5], [0.6]])
    write(tmp_path / "mean", _rows(0.7, first=7))
    (tmp_path / "notes").mkdir()
    runs = table.find(str(tmp_path))
    assert [str(run.relative_to(tmp_path)) for run in runs] == ["mean", "mine/0", "mine/1"]


def test_a_run_that_has_not_begun_is_left_out_of_its_folder(tmp_path: Path) -> None:
    folder = _array(tmp_path / "mine", [[0.5], [0.6]])
    write(folder / "2", [])
    assert len(table.find(str(folder))) == 2
    assert len(table.find(str(folder / "2"))) == 1


def test_a_seed_that_was_not_measured_has_no_part_in_the_mean(tmp_path: Path) -> None:
    (line,) = _lines([write(tmp_path, _rows(0.5, None, 0.7))])
    assert line.mean == pytest.approx(0.6)
    assert line.interval is None
    assert table.cells(line)[3] == "3, 2 measured"
    (none,) = _lines([write(tmp_path, _rows(None))])
    assert (none.mean, none.success) == (None, [None])


def test_a_run_that_decides_by_whole_episodes_is_measured_by_them(tmp_path: Path) -> None:
    curriculum = dataclasses.replace(CONFIG.curriculum, success="all")
    given = row(0, success_by_stage=[0.9, 0.8], complete_by_stage=[0.3, 0.2])
    trained = dataclasses.replace(CONFIG, curriculum=curriculum)
    (line,) = _lines([write(tmp_path, [given], trained=trained)])
    assert line.mean == pytest.approx(0.2)
    assert "Success: episodes in which all arrived on the last stage" in table.text([line])


def test_the_command_prints_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = _array(tmp_path / "mine", [[0.5, 0.6], [0.7, 0.8]])
    assert report.main([f"runs={folder}"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split()[:3] == ["settings", "stage", "updates"]
    assert "  65.0 %  " in printed[1]


def test_a_printed_line_has_at_most_100_characters(tmp_path: Path) -> None:
    wide = dataclasses.replace(
        MORE, budget=10**9, algo=dataclasses.replace(MORE.algo, clip_epsilon=0.3)
    )
    for folder, trained in {"a" * 150: CONFIG, "b" * 150: wide}.items():
        write(tmp_path / folder, _rows(0.5), trained=trained)
    printed = table.text(_lines(table.find(str(tmp_path)))).splitlines()
    assert max(map(len, printed)) <= 100


def test_a_word_is_not_cut_where_there_is_room(tmp_path: Path) -> None:
    (line,) = _lines([write(tmp_path, _rows(0.5))])
    words = ["algo.actor_learning_rate=0.001", "budget=300000", "stage=curriculum"]
    printed = table.text([line._replace(settings=" ".join(words), runs=["/tmp/somewhere/a"])])
    assert set(words) <= set(printed.split())


def test_own_code_is_named_without_its_digest(tmp_path: Path) -> None:
    own = dataclasses.replace(CONFIG, pieces=ByName({"reward": ByName({"mine": "0" * 64})}))
    runs = [write(tmp_path / "a", _rows(0.5)), write(tmp_path / "b", _rows(0.5), trained=own)]
    assert [line.settings for line in _lines(runs)] == ["", "reward=mine"]


def test_stages_of_one_name_are_told_apart_by_their_settings(tmp_path: Path) -> None:
    wide = (CONFIG.stage[0], dataclasses.replace(CONFIG.stage[1], side=0.9))
    other = dataclasses.replace(CONFIG, stage=wide)
    runs = [write(tmp_path / "a", _rows(0.5)), write(tmp_path / "b", _rows(0.5), trained=other)]
    assert [line.settings for line in _lines(runs)] == [
        "stage.trio.side=0.8",
        "stage.trio.side=0.9",
    ]
