"""Checks the figures of a report through the Matplotlib artists that draw them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from runs import CONFIG, row, write

from swarmjax.report import figures as report_figures
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import History
from swarmjax.task.stage_config import StageConfig

BOLD, THIN, LIMIT = "#0b4f9e", "0.62", "#c04000"


def _history(run: Path, rows: list[dict], stages: tuple[StageConfig, ...] | None = None) -> History:
    trained = replace(CONFIG, stage=stages) if stages else CONFIG
    return report_rows.read(write(run, rows, trained=trained))


def _stages(cells: list[tuple[int, int, float]]) -> tuple[StageConfig, ...]:
    return tuple(
        StageConfig(name=f"r{r}-o{o}-s{100 * s:.0f}", robots=r, obstacles=o, side=s)
        for r, o, s in cells
    )


def _wide_row(success: list[float | None], **given: object) -> dict:
    """Returns a row with a stage for each share of success, and arenas spread evenly."""
    count = len(success)
    lists = {key: [None] * count for key in row(0) if key.endswith("_by_stage")}
    return row(0) | lists | {"mix": [1] * count} | {"success_by_stage": success} | given


def _lines(panel: Axes, colour: str, style: str) -> list[np.ndarray]:
    """Returns the curves [points, 2] of one colour and style, without undrawn points."""
    found = [line for line in panel.lines if np.array_equal(line.get_color(), colour)]
    points = [np.asarray(line.get_xydata()) for line in found if line.get_linestyle() == style]
    return [each[~np.isnan(each[:, 1])] for each in points]


def test_the_mix_is_stacked_as_the_mean_over_seeds(tmp_path: Path) -> None:
    rows = [
        *(row(0, seed, mix=[8, 0]) for seed in (0, 1)),
        row(1, 0, mix=[4, 4]),
        row(1, 1, mix=[8, 0]),
    ]
    figure = report_figures.mix(_history(tmp_path, rows))
    axes = figure.axes[0]
    first, second = (band for band in axes.collections if isinstance(band, PolyCollection))
    low, high = (np.asarray(band.get_paths()[0].vertices) for band in (first, second))
    # The first update lasts from 0 to 64 arena control steps, the second to 128.
    assert set(low[low[:, 0] == 64][:, 1]) == {0.0, 1.0, (4 / 8 + 8 / 8) / 2}
    assert set(low[low[:, 0] == 128][:, 1]) == {0.0, 0.75}
    assert set(high[high[:, 0] == 128][:, 1]) == {0.75, 1.0}
    assert axes.get_xlim() == (0, 128)
    names = [label.get_text() for label in figure.legends[0].get_texts()]
    assert sorted(names) == ["pair", "trio"]


def test_many_updates_are_averaged_and_none_is_left_out(tmp_path: Path) -> None:
    # Every tenth update is on the other stage. There are ten times as many updates as points of a
    # band.
    rows = [row(i, mix=[0, 8] if i % 10 == 3 else [8, 0]) for i in range(2000)]
    figure = report_figures.mix(_history(tmp_path, rows))
    band = figure.axes[0].collections[1]
    heights = np.asarray(band.get_paths()[0].vertices)[:, 1]
    # Each of 199 stretches of 9 to 11 updates holds none, one or two updates of the other stage.
    assert heights.min() > 1.0 - 2.5 / 9
    assert (heights < 1.0).mean() > 0.4  # half of the outline is the lower edge


def test_names_in_the_legend_are_thinned_from_the_last(tmp_path: Path) -> None:
    stages = _stages([(2, 0, 0.5 + 0.01 * i) for i in range(48)])
    figure = report_figures.mix(_history(tmp_path, [_wide_row([None] * 48)], stages))
    names = [label.get_text() for label in figure.legends[0].get_texts()]
    assert names == [stage.name for stage in stages][::-2]


def test_success_has_every_seed_and_their_interquartile_mean(tmp_path: Path) -> None:
    shares = [0.1, 0.2, 0.4, 0.9]
    rows = [row(0, seed, success_by_stage=[share, None]) for seed, share in enumerate(shares)]
    rows += [row(1, seed, success_by_stage=[0.5, 0.25 if seed else None]) for seed in range(4)]
    figure = report_figures.stages(_history(tmp_path, rows))
    pair, trio = figure.axes
    [bold] = _lines(pair, BOLD, "-")
    # The interquartile mean of four is the mean of the middle two. Rows hold float32.
    assert bold == pytest.approx(np.array([[64, 0.3], [128, 0.5]]), rel=1e-6)
    assert [line[0, 1] for line in _lines(pair, THIN, "-")] == pytest.approx(shares, rel=1e-6)
    assert pair.get_title(loc="left") == "pair   50 %"
    # One seed has no success on the second stage, so there is no mean.
    assert [len(line) for line in _lines(trio, BOLD, "-")] == [0]
    assert [len(line) for line in _lines(trio, THIN, "-")] == [0, 1, 1, 1]
    assert trio.get_title(loc="left") == "trio   25 %"


def test_the_share_that_promotes_is_drawn(tmp_path: Path) -> None:
    figure = report_figures.stages(_history(tmp_path, [_wide_row([0.5] * 2)]))
    [drawn] = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    assert np.asarray(drawn.get_ydata()).tolist() == [0.8, 0.8]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["seed 0", "promotes"]


def test_the_learning_curve_has_the_last_stage_and_those_before_it(tmp_path: Path) -> None:
    rows = [row(i, success_by_stage=[0.75, share]) for i, share in enumerate([0.25, 0.5])]
    figure = report_figures.success(_history(tmp_path, rows))
    [panel] = figure.axes
    [bold] = _lines(panel, BOLD, "-")
    assert bold.tolist() == [[64, 0.25], [128, 0.5]]
    assert np.asarray(panel.lines[0].get_ydata()).tolist() == [0.75, 0.75]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["seed 0", "pair"]


def test_the_learning_curve_of_a_single_stage_is_its_own(tmp_path: Path) -> None:
    rows = [_wide_row([0.5], **{"seed": seed}) for seed in range(2)]
    figure = report_figures.success(_history(tmp_path, rows, CONFIG.stage[:1]))
    assert len(figure.axes[0].lines) == 3
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["interquartile mean of 2 seeds", "each seed"]


def test_each_panel_shows_the_threshold_of_its_stage(tmp_path: Path) -> None:
    history = _history(tmp_path, [_wide_row([0.5] * 2)])
    options = replace(history.config.curriculum, threshold=(0.9, 0.7))
    config = replace(history.config, curriculum=options)
    figure = report_figures.stages(replace(history, config=config))
    shown = [_lines(panel, LIMIT, "--")[0][0, 1] for panel in figure.axes[:2]]
    assert shown == [0.9, 0.7]


def test_a_panel_for_each_of_many_stages(tmp_path: Path) -> None:
    stages = _stages([(2, 0, 0.5 + 0.01 * i) for i in range(34)])
    figure = report_figures.stages(_history(tmp_path, [_wide_row([0.5] * 34)], stages))
    shown = [panel for panel in figure.axes if panel.get_visible()]
    titles = [panel.get_title(loc="left").split()[0] for panel in shown]
    assert titles == [stage.name for stage in stages]
    # Each row has 8 panels. The last panel of each column is labelled with the steps, even where
    # the last row is not full.
    labelled = [panel.xaxis.get_tick_params()["labelbottom"] for panel in shown]
    assert labelled == [False] * 26 + [True] * 8


def _panel(history: History, title: str) -> Axes:
    figure = report_figures.curves(history)
    assert figure is not None
    (found,) = (each for each in figure.axes if each.get_title(loc="left") == title)
    return found


def test_a_curve_has_every_seed_and_their_interquartile_mean(tmp_path: Path) -> None:
    values = [1.0, 2.0, 4.0, 9.0]
    rows = [row(0, seed, value_loss=value) for seed, value in enumerate(values)]
    panel = _panel(_history(tmp_path, rows), "value loss")
    assert [line[0].tolist() for line in _lines(panel, THIN, "-")] == [[64, v] for v in values]
    [bold] = _lines(panel, BOLD, "-")
    assert bold.tolist() == [[64, 3.0]]  # the mean of 2 and 4


def test_a_curve_leaves_out_what_was_not_measured(tmp_path: Path) -> None:
    rows = [row(i, **{"return": value}) for i, value in enumerate([None, 0.5, None, 0.25])]
    [bold] = _lines(_panel(_history(tmp_path, rows), "return per robot"), BOLD, "-")
    assert bold.tolist() == [[128, 0.5], [256, 0.25]]


def test_a_curve_is_a_line_over_updates_without_a_value(tmp_path: Path) -> None:
    rows = [row(i, entropy=None if i % 2 else 0.5) for i in range(5)]
    panel = _panel(_history(tmp_path, rows), "entropy of the policy")
    assert np.asarray(panel.lines[-1].get_xydata()).tolist() == [[64, 0.5], [192, 0.5], [320, 0.5]]


def test_a_single_value_is_a_dot(tmp_path: Path) -> None:
    panel = _panel(_history(tmp_path, [row(0, entropy=0.5), row(1)]), "entropy of the policy")
    assert panel.lines[-1].get_marker() == "o"


def test_a_run_of_one_stage_has_no_figures_of_a_curriculum(tmp_path: Path) -> None:
    history = _history(tmp_path, [_wide_row([0.5])], CONFIG.stage[:1])
    assert list(report_figures.png_files(history)) == ["success"]


def test_a_long_curve_is_averaged_and_nothing_is_left_out(tmp_path: Path) -> None:
    rows = [row(i, entropy=10.0 if i == 777 else 0.0) for i in range(2000)]
    [bold] = _lines(_panel(_history(tmp_path, rows), "entropy of the policy"), BOLD, "-")
    assert len(bold) == 200
    assert bold[:, 1].max() == pytest.approx(1.0, rel=0.2)  # one 10 in about ten updates


def test_a_run_without_these_numbers_has_no_curves(tmp_path: Path) -> None:
    assert report_figures.curves(_history(tmp_path, [row(0)])) is None


def test_files_are_png_and_the_same_again(tmp_path: Path) -> None:
    wide = _wide_row([0.1, 0.2, None, 0.4, 0.5], entropy=1.0)
    history = _history(tmp_path, [wide], _stages([(2, 0, 0.5 + 0.1 * i) for i in range(5)]))
    files = report_figures.png_files(history)
    assert list(files) == ["success", "stages", "mix", "curves"]
    assert all(content.startswith(b"\x89PNG\r\n") for content in files.values())
    assert not any(b"Matplotlib" in content for content in files.values())
    assert report_figures.png_files(history) == files


def test_a_goals_own_measure_has_a_panel(tmp_path: Path) -> None:
    rows = [row(i, entropy=0.0, measured_floor_seen=value) for i, value in enumerate([0.25, 0.75])]
    [bold] = _lines(_panel(_history(tmp_path, rows), "floor seen"), BOLD, "-")
    assert bold.tolist() == [[64, 0.25], [128, 0.75]]
