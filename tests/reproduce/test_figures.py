"""Tests what the figures of a reproduction show, read from their Matplotlib artists."""

import math

import numpy as np
import pytest
from matplotlib.figure import Figure
from reproductions import log, reproduction, whole

from swarmjax.reproduce import figures, measures
from swarmjax.reproduce import rows as reproduce_rows
from swarmjax.reproduce.figures import columns, raster
from swarmjax.reproduce.rows import LAST

PAIR = ("curriculum", "baseline")


def test_a_column_shows_what_ended_in_it_or_was_under_way() -> None:
    # The episodes end at 100, 250, 260 and 420 arena steps.
    one = log([True, False, True, True], arena_steps=np.array([100, 250, 260, 420]))
    edges = np.array([0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0])
    found = columns(one, measures.first_reached, "steps", None, edges)
    # The end at 100 lies in the first column. In the second column the episode that ends at 250 is
    # under way. In the third column one of two episodes succeeds. No episode follows after 420.
    np.testing.assert_array_equal(found, [1.0, 0.0, 0.5, 1.0, 1.0, math.nan])


def test_a_column_leaves_other_stages_out() -> None:
    stage = np.array(["paper1", "paper1", LAST, LAST])
    one = log([True, False, True, True], arena_steps=np.array([100, 250, 260, 420]), stage=stage)
    edges = np.array([0.0, 100.0, 200.0, 300.0, 400.0, 500.0])
    found = columns(one, measures.first_reached, "steps", LAST, edges)
    np.testing.assert_array_equal(found, [math.nan, math.nan, 1.0, 1.0, 1.0])


def test_a_raster_has_a_row_a_seed_and_a_column_an_episode() -> None:
    slow = log([False] * 10 + [True] * 30)
    never = log([False] * 30)
    data = reproduction({"curriculum": [slow, slow, never], "baseline": [never] * 3})
    figure = raster(data, PAIR, axis="episode", stage=None)
    panels = figure.axes
    assert [panel.get_title(loc="left") for panel in panels] == [
        f"{arm}: {name}" for name in measures.SUCCESS for arm in PAIR
    ]
    shown = np.ma.filled(np.ma.asarray(panels[0].images[0].get_array()), np.nan)
    np.testing.assert_array_equal(shown[0], [0.0] * 10 + [1.0] * 30)
    np.testing.assert_array_equal(shown[2], [0.0] * 30 + [np.nan] * 10)
    # A window may hold four failures, so success is steady from episode 7 on. A seed that never
    # becomes steady has no mark.
    marks = np.ma.filled(np.ma.asarray(panels[0].collections[0].get_offsets()), np.nan)
    np.testing.assert_array_equal(marks[np.isfinite(marks[:, 0])], [[7, 0], [7, 1]])
    # The vertical lines mark the paper's numbers.
    lines = [np.asarray(panel.lines[0].get_xdata())[0] for panel in panels]
    assert lines == [300, 600, 300, 600]


def _curve(figure: Figure, place: int, width: float) -> list[np.ndarray]:
    """Returns the curves [points, 2] of a panel that have this line width."""
    lines = figure.axes[place].lines
    return [np.asarray(each.get_xydata()) for each in lines if each.get_linewidth() == width]


def test_curves_are_rolling_means_and_their_interquartile_mean() -> None:
    def paid(amount: float) -> np.ndarray:
        return np.full((30, 2), amount)

    seeds = [log([True] * 30, reward=paid(amount)) for amount in (1.0, 2.0, 6.0)]
    panel = figures.Panel(measures.first_reward)
    figure = figures.curves(
        reproduction({"baseline": seeds}), ("baseline",), panels=(panel,), axes=("episode", "steps")
    )
    thin = _curve(figure, 0, 0.5)
    assert [line[0].tolist() for line in thin] == [[20, 1.0], [20, 2.0], [20, 6.0]]
    assert [len(line) for line in thin] == [11] * 3
    [thick] = _curve(figure, 0, 2.0)
    # The interquartile mean of three values trims none.
    np.testing.assert_array_equal(thick, [[number, 3.0] for number in range(20, 31)])
    [thick] = _curve(figure, 1, 2.0)
    assert thick[[0, -1]].tolist() == [[2000, 3.0], [3000, 3.0]]


def test_no_mean_is_drawn_where_a_seed_has_no_episodes() -> None:
    stage = np.array(["paper1"] * 30)
    seeds = [log([True] * 30), log([True] * 30), log([True] * 30, stage=stage)]
    panel = figures.Panel(measures.first_reward, LAST)
    data = reproduction({"curriculum": seeds})
    figure = figures.curves(data, ("curriculum",), panels=(panel,), axes=("steps",))
    assert [len(line) for line in _curve(figure, 0, 0.5)] == [11, 11, 0]
    assert _curve(figure, 0, 2.0) == []


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = whole(tmp_path_factory.mktemp("out"), episodes=25, arms=("curriculum",))
    return figures.png_files(reproduce_rows.read(out))


def test_figures_of_arms_that_have_not_finished_are_left_out(drawn: dict[str, bytes]) -> None:
    lacking = {"figure9_raster", "figure9_curves", "modern_raster"}
    assert set(drawn) == figures.PLOTS.keys() - lacking
    assert all(png.startswith(b"\x89PNG") for png in drawn.values())
