"""Checks what a report reads of a run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runs import CONFIG, row, write
from sentences import refusal

from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.report import rows as report_rows

NAN = np.nan


def test_rows_become_arrays_by_seed_and_update(tmp_path: Path) -> None:
    rows = [
        row(0, 8, mix=[8, 0]),
        row(0, 7, mix=[6, 2], success_by_stage=[0.5, None]),
        row(1, 7, mix=[2, 6], success_by_stage=[0.75, 0.125]),
        row(1, 8, mix=[0, 8], contacts_by_stage=[2.0, None], complete_by_stage=[None, 0.25]),
    ]
    history = report_rows.read(write(tmp_path, rows))
    assert history.names == ["pair", "trio"]
    assert history.seeds.tolist() == [7, 8]
    assert history.updates.tolist() == [0, 1]
    assert history.arena_steps.tolist() == [64, 128]
    assert history.seconds == 60.0
    expected = [[[0.75, 0.25], [0.25, 0.75]], [[1.0, 0.0], [0.0, 1.0]]]
    np.testing.assert_array_equal(history.mix, expected)
    expected = [[[0.5, NAN], [0.75, 0.125]], [[NAN, NAN], [NAN, NAN]]]
    np.testing.assert_array_equal(history.success, expected)
    np.testing.assert_array_equal(history.by_stage["contacts_by_stage"][1, 1], [2.0, NAN])


def test_numbers_of_an_update_may_be_null_or_missing(tmp_path: Path) -> None:
    rows = [row(0, value_loss=0.5), row(1, value_loss=None), row(2)]
    history = report_rows.read(write(tmp_path, rows))
    np.testing.assert_array_equal(history.curves["value_loss"], [[0.5, NAN, NAN]])


def test_success_is_what_the_curriculum_decides_by(tmp_path: Path) -> None:
    rows = [row(0, success_by_stage=[0.9, None], complete_by_stage=[0.7, None])]
    by_all = replace(CONFIG, curriculum=CurriculumConfig(success="all"))
    history = report_rows.read(write(tmp_path, rows, trained=by_all))
    assert history.success[0, 0, 0] == np.float32(0.7)
    assert report_rows.measure(history) == "episodes in which all arrived"


def test_updates_that_a_seed_lacks_are_left_out(tmp_path: Path) -> None:
    rows = [row(0, 0), row(1, 0), row(0, 1), row(1, 1), row(2, 0)]  # killed within update 2
    history = report_rows.read(write(tmp_path, rows))
    assert history.updates.tolist() == [0, 1]
    assert history.mix.shape == (2, 2, 2)


def test_all_null_is_no_measurement_and_no_share(tmp_path: Path) -> None:
    history = report_rows.read(write(tmp_path, [row(0, mix=[None, None])]))
    assert np.isnan(history.success).all()
    assert not history.mix.any()


def test_decisions_are_in_the_order_of_seeds_and_updates(tmp_path: Path) -> None:
    found = [{"seed": seed, "update": update} for seed, update in ((1, 0), (0, 5), (0, 2))]
    history = report_rows.read(write(tmp_path, [row(0)], found))
    order = [(entry["seed"], entry["update"]) for entry in history.decisions]
    assert order == [(0, 2), (0, 5), (1, 0)]


def test_seeds_are_put_together_where_all_have_a_value() -> None:
    # The interquartile mean of four values is (2 + 3) / 2; their mean would be 27.5.
    values = np.array([[1.0, 1.0], [2.0, NAN], [3.0, 1.0], [104.0, 1.0]])
    np.testing.assert_array_equal(report_rows.together(values), [2.5, NAN])


def test_seeds_without_a_value_are_left_out_and_counted() -> None:
    values = np.array([[1.0, NAN, NAN], [2.0, 0.5, NAN], [3.0, 0.25, NAN], [104.0, NAN, NAN]])
    mean, measured = report_rows.among(values)
    np.testing.assert_array_equal(mean, [2.5, 0.375, NAN])
    assert measured.tolist() == [4, 2, 0]


@pytest.mark.parametrize(
    ("file", "what"),
    [
        ("config.json", "{run} is not a run directory: it has no config.json."),
        ("metrics.jsonl", "{run} has no metrics.jsonl: it holds no training yet."),
        ("curriculum.jsonl", "{run} has no curriculum.jsonl: it holds no training yet."),
    ],
)
def test_a_file_that_is_not_there_is_named(file: str, what: str, tmp_path: Path) -> None:
    write(tmp_path, [row(0)])
    (tmp_path / file).unlink()
    assert refusal(report_rows.read, tmp_path) == what.format(run=tmp_path)


@pytest.mark.parametrize(
    ("file", "content", "what"),
    [
        ("metrics.jsonl", "", " has no update that every seed recorded: train first."),
        (
            "metrics.jsonl",
            '{"seed": 0, "upd',
            " has no update that every seed recorded: train first.",
        ),
        ("metrics.jsonl", '{"seed": 0, "upd\n{}\n', " in line 1 is damaged: resume the run"),
        ("metrics.jsonl", "[]\n", " in line 1 is damaged: resume the run, or remove the line."),
        ("metrics.jsonl", "[" * 10**5 + "\n", " in line 1 is damaged: resume the run"),
        ("metrics.jsonl", "9" * 5000 + "\n", " in line 1 is damaged: resume the run"),
        ("metrics.jsonl", "\n", " in line 1 is damaged: resume the run, or remove the line."),
        ("metrics.jsonl", "\xff\xfe\n", " in line 1 is damaged: "),
        (
            "metrics.jsonl",
            '{"seed": 0, "update": 0}\n',
            " in line 1 has no whole number as ",
        ),
        ("curriculum.jsonl", '{"seed": 0, "upd\n', " in line 1 is damaged: resume the run"),
        ("curriculum.jsonl", '{"seed": 0}\n', " in line 1 has no whole number as update: it is"),
        ("config.json", "{", " cannot be read as JSON: "),
        ("config.json", "[]", " is not a run's config: it holds no JSON object."),
        ("summary.json", "{", " cannot be read as JSON: "),
    ],
)
def test_a_damaged_file_is_named_with_its_line(
    file: str, content: str, what: str, tmp_path: Path
) -> None:
    write(tmp_path, [row(0)])
    (tmp_path / file).write_bytes(content.encode("latin-1"))
    assert refusal(report_rows.read, tmp_path).startswith(f"{tmp_path / file}{what}")


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"seed": None}, " has no whole number as seed: it is damaged."),
        ({"seed": 2**63}, " has no whole number as seed: it is damaged."),
        ({"train_s": 1e300}, " has no number as train_s: it is damaged."),
        ({"update": True}, " has no whole number as update: it is damaged."),
        ({"train_s": "30.0"}, " has no number as train_s: it is damaged."),
        ({"train_s": NAN}, " has no number as train_s: it is damaged."),
        ({"mix": ["8", "0"]}, " has no list of 2 numbers as mix: it is damaged."),
        ({"mix": [8]}, " has no list of 2 numbers as mix: it is damaged."),
        ({"mix": "x"}, " has no list of 2 numbers as mix: it is damaged."),
        (
            {"success_by_stage": [[1], [2, 3]]},
            " has no list of 2 numbers as success_by_stage: it is damaged.",
        ),
    ],
)
def test_a_row_that_does_not_fit_is_named(given: dict, what: str, tmp_path: Path) -> None:
    write(tmp_path, [row(0), row(1) | given])
    sentence = refusal(report_rows.read, tmp_path)
    assert sentence == f"{tmp_path / 'metrics.jsonl'} in line 2{what}"


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"targets_reached": "0.5"}, " has no number as targets_reached: it is damaged."),
        ({"all_reached": [0.5]}, " has no number as all_reached: it is damaged."),
    ],
)
def test_a_decision_that_does_not_fit_is_named(given: dict, what: str, tmp_path: Path) -> None:
    whole = {"seed": 0, "update": 0, "targets_reached": None, "all_reached": 1}
    write(tmp_path, [row(0)], [whole, {"seed": 0, "update": 1} | given])
    sentence = refusal(report_rows.read, tmp_path)
    assert sentence == f"{tmp_path / 'curriculum.jsonl'} in line 2{what}"


@pytest.mark.parametrize("cut", [1, 20])
def test_an_unfinished_last_line_is_skipped(cut: int, tmp_path: Path) -> None:
    # A line without its newline counts as not written, whether or not more of it is missing.
    found = [{"seed": 0, "update": update, "why": "threshold"} for update in range(3)]
    write(tmp_path, [row(0), row(1), row(2)], found)
    for name in ("metrics.jsonl", "curriculum.jsonl"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(text[:-cut])
    history = report_rows.read(tmp_path)
    assert history.updates.tolist() == [0, 1]
    assert history.seconds == 60.0
    assert history.decisions == found[:2]


def test_a_config_that_is_refused_is_named(tmp_path: Path) -> None:
    write(tmp_path, [row(0)])
    (tmp_path / "config.json").write_text('{"arenas": 0}')
    sentence = refusal(report_rows.read, tmp_path)
    assert sentence.startswith(f"{tmp_path / 'config.json'} is not valid: stage is missing")
