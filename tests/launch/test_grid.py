"""Checks that a grid of settings gives a cell for each combination of values."""

import json
from pathlib import Path
from typing import Any

import pytest

from swarmjax.config import ConfigError


def test_a_cell_is_a_combination_of_values(sweep: Any, tmp_path: Path) -> None:
    cells = sweep.multiply(tmp_path, ["grid.algo.epochs=1,2", "seeds=5", "grid.arenas=64,128"])
    assert [cell.label for cell in cells] == [
        "algo.epochs=1 arenas=64",
        "algo.epochs=1 arenas=128",
        "algo.epochs=2 arenas=64",
        "algo.epochs=2 arenas=128",
    ]
    assert cells[0].run.name == "algo.epochs=1_arenas=64"
    assert cells[3].words == (
        *("seeds=5", "algo.epochs=2", "arenas=128"),
        *("resume=auto", f"run.dir={cells[3].run}"),
    )
    last = cells[3].settings
    assert (last.algo.epochs, last.arenas, last.seeds) == (2, 128, 5)
    assert last.run.dir == str(cells[3].run)


_RANGE = ",".join(map(str, range(300)))


@pytest.mark.parametrize(
    ("word", "labels", "folders"),
    [
        ("grid.algo.epochs=3", ["algo.epochs=3"], ["algo.epochs=3"]),
        (
            "grid.algo.hidden_sizes=[8],[8,4]",
            ["algo.hidden_sizes=[8]", "algo.hidden_sizes=[8,4]"],
            ["algo.hidden_sizes=8", "algo.hidden_sizes=8-4"],
        ),
        (
            "grid.run.wandb=a-b,'c,d'",
            ["run.wandb=a-b", "run.wandb=c,d"],
            ["run.wandb=a-b", "run.wandb=c-d"],
        ),
        ("grid.stage=s1,s6", ["stage=s1", "stage=s6"], ["stage=s1", "stage=s6"]),
        (
            "grid.algo.actor_learning_rate=1e-4,0.001",
            ["algo.actor_learning_rate=0.0001", "algo.actor_learning_rate=0.001"],
            ["algo.actor_learning_rate=0.0001", "algo.actor_learning_rate=0.001"],
        ),
    ],
)
def test_values_are_a_list_in_yaml(
    sweep: Any, word: str, labels: list[str], folders: list[str], tmp_path: Path
) -> None:
    cells = sweep.multiply(tmp_path, [word])
    assert [cell.label for cell in cells] == labels
    assert [cell.run.name for cell in cells] == folders


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "the grid is empty: give values, as in grid.algo.epochs=1,2."),
        (["arenas=64"], "the grid is empty: give values, as in grid.algo.epochs=1,2."),
        (["grid.arenas="], "arenas is null: give a whole number."),
        (["grid.algo.epocs=1,2"], "algo.epocs is not a key: did you mean algo.epochs?"),
        (["grid.nothing=1,2"], "nothing is not a key: "),
        (["grid.=1,2"], "'=1' is not a setting: give key=value."),
        (["grid.seed"], "'grid.seed' is not a setting: give key=value."),
        (["grid.seed=1,2", "seds=2"], "seds is not a key: did you mean seeds?"),
        (["grid.seed=range(3)"], "seed is 'range(3)': give a whole number."),
        ([f"grid.seed={_RANGE}"], "the grid has more than 256 cells: give fewer values."),
        (
            [f"grid.seed={_RANGE[:50]}", f"grid.budget={_RANGE[:50]}"],
            "the grid has more than 256 cells: give fewer values.",
        ),
        (["grid.seed=1,1"], "two cells of the grid would be DIR/seed=1: give values that differ."),
        (["grid.seed=[1,2"], "grid.seed is '[1,2', which cannot be read: did not find"),
        (
            ["grid.arenas=64,128", "arenas=32"],
            "arenas is given twice: give each key once.",
        ),
        (["grid.arenas=64", "grid.arenas=128"], "arenas is given twice: give each key once."),
        (["grid.run.dir=a,b"], "grid.run.dir cannot be given: each cell of the grid has its own."),
        (
            ["grid.seed=1,2", "resume=a"],
            "resume cannot be given: each cell of the grid has its own.",
        ),
        (
            ["grid.arenas=64,65"],
            "arenas is 65, but algo.num_minibatches is 8: give a multiple of 8.",
        ),
    ],
)
def test_what_is_no_grid_is_refused(
    sweep: Any, words: list[str], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as caught:
        sweep.multiply(tmp_path, words)
    assert str(caught.value).replace(str(tmp_path), "DIR").startswith(sentence)


@pytest.mark.parametrize(
    ("summary", "done"),
    [
        (None, False),
        ({"budget_spent": True, "updates": 488}, True),
        ({"budget_spent": True, "updates": 487}, False),
        ({"budget_spent": False, "updates": 488}, False),
        ({"budget_spent": False, "updates": 64, "stopped_at": 0.9}, True),
        ({"budget_spent": False, "updates": 64, "stopped_at": 0.8}, False),
        ([1], False),
    ],
)
def test_a_cell_is_done_when_its_budget_is_spent_or_its_success_is_reached(
    sweep: Any, summary: object, done: bool, tmp_path: Path
) -> None:
    (cell,) = sweep.multiply(
        tmp_path, ["grid.arenas=64", "stage=s1", "budget=999424", "run.stop_at=0.9"]
    )
    assert cell.settings.updates == 488
    cell.run.mkdir()
    if summary is not None:
        (cell.run / "summary.json").write_text(json.dumps(summary))
    assert cell.is_done is done
