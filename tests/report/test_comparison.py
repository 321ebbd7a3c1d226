"""Checks the picture of several runs through the Matplotlib artists that draw it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from runs import CONFIG, row, write

from swarmjax.evaluate.statistics import iqm
from swarmjax.report import __main__ as report
from swarmjax.report import comparison, table
from swarmjax.report.table import Group
from swarmjax.run.settings import TrainConfig

MORE = dataclasses.replace(CONFIG, algo=dataclasses.replace(CONFIG.algo, epochs=3))
ONE = dataclasses.replace(CONFIG, stage=CONFIG.stage[1:], stage_name="")
SHARES = [0.1, 0.2, 0.4, 0.9]


def _run(run: Path, success: list[list[float | None]], trained: TrainConfig = CONFIG) -> Path:
    """Writes a run with the success [N, T] of each seed on every stage."""
    stages = len(trained.stage)
    keys = ("success_by_stage", "complete_by_stage", "contacts_by_stage", "return_by_stage")
    rows = [
        row(update, trained.seed + seed, mix=[1] * stages, weights=[1.0] * stages)
        | {key: [share] * stages for key in keys}
        for seed, shares in enumerate(success)
        for update, share in enumerate(shares)
    ]
    return write(run, rows, trained=dataclasses.replace(trained, seeds=len(success)))


def _groups(*runs: Path) -> list[Group]:
    return table.read(runs)


def _curves(panel: Axes) -> list[np.ndarray]:
    """Returns the curves [points, 2] of a panel."""
    return [np.asarray(line.get_xydata()) for line in panel.lines]


def test_a_curve_is_the_mean_over_seeds_with_its_interval(tmp_path: Path) -> None:
    run = _run(tmp_path / "a", [[share, share / 2] for share in SHARES])
    figure = comparison.success(_groups(run), ["pair", "trio"])
    for panel in figure.axes:
        [curve] = _curves(panel)
        mean = iqm(SHARES)
        assert curve == pytest.approx(np.array([[64, mean], [128, mean / 2]]), rel=1e-6)
        [band] = (each for each in panel.collections if isinstance(each, PolyCollection))
        heights = np.asarray(band.get_paths()[0].vertices)
        at_first = heights[heights[:, 0] == 64][:, 1]
        assert 0.1 <= at_first.min() < mean < at_first.max() <= 0.9 + 1e-6
    assert figure.get_supylabel() == "targets reached, interquartile mean"


def test_runs_have_a_curve_each_of_their_own_colour_and_style(tmp_path: Path) -> None:
    runs = [_run(tmp_path / "_a", [[0.5, 0.6]]), _run(tmp_path / "b", [[0.7]], MORE)]
    figure = comparison.success(_groups(*runs), ["pair"])
    [panel] = figure.axes
    assert [len(curve) for curve in _curves(panel)] == [2, 1]
    assert panel.get_xlim() == (0, 128)
    first, second = panel.lines
    assert first.get_linestyle() != second.get_linestyle()
    dark, light = (float(np.mean(to_rgb(line.get_color()))) for line in panel.lines)
    assert light - dark > 0.2
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [name.split(" (1 seed) ")[1] for name in names] == ["algo.epochs=1", "algo.epochs=3"]
    assert [name.split(" (1 seed) ")[0][-2:] for name in names] == ["_a", "/b"]
    assert not panel.collections  # one seed has no interval


def test_jobs_of_an_array_are_one_curve_up_to_the_slowest(tmp_path: Path) -> None:
    other = dataclasses.replace(CONFIG, seed=1)
    runs = [_run(tmp_path / "0", [[0.2, 0.4]]), _run(tmp_path / "1", [[0.4]], other)]
    figure = comparison.success(_groups(*runs), ["pair"])
    [curve] = _curves(figure.axes[0])
    assert curve == pytest.approx(np.array([[64, 0.3]]), rel=1e-6)


def test_there_is_no_curve_where_a_seed_was_not_measured(tmp_path: Path) -> None:
    run = _run(tmp_path / "a", [[None, 0.5], [0.3, 0.5], [0.3, 0.5]])
    figure = comparison.success(_groups(run), ["pair"])
    [curve] = _curves(figure.axes[0])
    assert curve.tolist() == [[128, 0.5]]


def test_a_shared_name_of_different_stages_is_said(tmp_path: Path) -> None:
    wide = dataclasses.replace(CONFIG.stage[1], side=0.9)
    trained = dataclasses.replace(ONE, stage=(wide,))
    runs = [_run(tmp_path / "a", [[0.5]]), _run(tmp_path / "b", [[0.7]], trained)]
    figure = comparison.success(_groups(*runs), ["trio"])
    assert figure.axes[0].get_title(loc="left") == "trio, not the same in all runs"


def test_the_command_draws_the_stages_in_common(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = f"{_run(tmp_path / 'a', [[0.5]])},{_run(tmp_path / 'b', [[0.7]], ONE)}"
    assert report.main([f"runs={runs}"]) == 0
    picture = tmp_path / "report" / "comparison.png"
    said = " ".join(capsys.readouterr().out.split())  # a long path breaks the line
    assert said.endswith(f"{picture}: success on 1 stage over training.")
    drawn = picture.read_bytes()
    assert report.main([f"runs={runs}", f"out={tmp_path / 'there'}"]) == 0
    assert (tmp_path / "there" / "comparison.png").read_bytes() == drawn


def test_runs_without_a_stage_in_common_have_no_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = dataclasses.replace(CONFIG, stage=CONFIG.stage[:1], stage_name="")
    runs = f"{_run(tmp_path / 'a', [[0.5]], pair)},{_run(tmp_path / 'b', [[0.7]], ONE)}"
    assert report.main([f"runs={runs}"]) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == "No picture: these runs have no stage in common."
    assert not (tmp_path / "report").exists()
