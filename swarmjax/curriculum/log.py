"""The decision log: each decision of the curriculum and the metrics behind it."""

from collections.abc import Sequence

from swarmjax.curriculum.engine import REASONS, REWEIGHED, STAYED


def log(rows: Sequence[dict], names: Sequence[str], seed: int) -> list[dict]:
    """Turns rows of metrics into the decision log.

    Args:
      rows: metrics, one row for each update of one seed, with the names that `loop.update` uses.
        Metrics by stage are lists.
      names: names of the stages.
      seed: seed to write into the entries.

    Returns:
      One entry for each decision: `update`, `seed` and `why`. A promotion also has
      `from`, `to` and the results on the stage that was left (`targets_reached`, `all_reached`,
      `episodes`). An entry for new weights also has `weights` and
      `success`, each by the name of the stage.
    """
    return [
        {"update": row["update"], "seed": seed, **_entry(row, names)}
        for row in rows
        if row["decision"] != STAYED
    ]


def _entry(row: dict, names: Sequence[str]) -> dict:
    """Describes the decision of an update, with the metrics behind it."""
    why = {"why": REASONS[row["decision"]]}
    if row["decision"] == REWEIGHED:
        figures = {"weights": row["weights"], "success": row["estimate_by_stage"]}
        return why | {key: dict(zip(names, each, strict=True)) for key, each in figures.items()}
    left = row["decided_stage"]
    figures = {"targets_reached": "success", "all_reached": "complete", "episodes": "episodes"}
    return (
        {"from": names[left], "to": names[row["next_stage"]]}
        | why
        | {key: row[f"{figure}_by_stage"][left] for key, figure in figures.items()}
    )
