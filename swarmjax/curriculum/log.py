"""The decision log: each decision of the curriculum and the figures behind it."""

from collections.abc import Sequence

from swarmjax.curriculum.engine import REASONS, REWEIGHED, STAYED


def log(rows: Sequence[dict], names: Sequence[str], seed: int) -> list[dict]:
    """Turns rows of metrics into the decision log.

    Args:
      rows: metrics, a row for each update of a seed, with the names of `loop.update`; lists by
        stage.
      names: names of the stages.
      seed: seed to write into the entries.

    Returns:
      One entry for each decision: `update`, `seed` and `why`. A promotion also has
      `from`, `to` and the results on the stage that was left (`targets_reached`, `all_reached`,
      `episodes`). New weights have `weights` and `success`, by stage.
    """
    return [
        {"update": row["update"], "seed": seed, **_entry(row, names)}
        for row in rows
        if row["decision"] != STAYED
    ]


def _entry(row: dict, names: Sequence[str]) -> dict:
    """Describes the decision of an update, with the figures behind it."""
    why = {"why": REASONS[row["decision"]]}
    if row["decision"] == REWEIGHED:
        weights, success = row["weights"], row["estimate_by_stage"]
        return why | {
            "weights": dict(zip(names, weights, strict=True)),
            "success": dict(zip(names, success, strict=True)),
        }
    left = row["decided_stage"]
    return (
        {"from": names[left], "to": names[row["next_stage"]]}
        | why
        | {
            "targets_reached": row["success_by_stage"][left],
            "all_reached": row["complete_by_stage"][left],
            "episodes": row["episodes_by_stage"][left],
        }
    )
