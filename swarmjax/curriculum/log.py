"""The decision log: each decision of the curriculum and the figures behind it."""

from collections.abc import Sequence

from swarmjax.curriculum.engine import REASONS, REWEIGHED, STAYED

_OF_LEVELS = ("held", "success", "score")


def log(rows: Sequence[dict], names: Sequence[str], seed: int) -> list[dict]:
    """Turns rows of metrics into the decision log.

    Args:
      rows: metrics, a row for each update of a seed, with the names of `loop.update`; lists by
        stage.
      names: names of the stages.
      seed: seed to write into the entries.

    Returns:
      One entry for each decision: `update`, `seed` and `why`. A promotion or demotion also has
      `from`, `to` and the results on the stage that was left (`targets_reached`, `all_reached`,
      `episodes`). New weights have `weights` and `success`, by stage. With a curriculum over
      levels, the entry also has `levels`. For each stage it gives the number of levels in the
      buffer (`held`), and the mean `success` and `score` of these levels.
    """
    return [
        {"update": row["update"], "seed": seed, **_entry(row, names), **_levels(row, names)}
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


def _levels(row: dict, names: Sequence[str]) -> dict:
    """Describes the practised levels, if there is a buffer of levels."""
    if "levels_held" not in row:
        return {}
    told = [row[f"levels_{key}"] for key in _OF_LEVELS]
    each = [dict(zip(_OF_LEVELS, of_stage, strict=True)) for of_stage in zip(*told, strict=True)]
    return {"levels": dict(zip(names, each, strict=True))}
