"""The decision log: rows of metrics as what the curriculum decided, and by which figures."""

from collections.abc import Sequence

from swarmjax.curriculum.engine import REASONS, REWEIGHED, STAYED

_OF_LEVELS = ("held", "success", "score")


def log(rows: Sequence[dict], names: Sequence[str], seed: int) -> list[dict]:
    """Turns rows of metrics into the decision log.

    Args:
      rows: metrics of one update of one seed each, as `loop.update` names them; lists by stage.
      names: of the stages.
      seed: what the entries say of it.

    Returns:
      One entry a decision: `update`, `seed` and `why`; for a promotion or demotion `from`, `to`
      and what was measured on the stage that was left (`targets_reached`, `all_reached`,
      `episodes`), for new weights `weights` and `success`, by stage. With a curriculum over levels
      `levels` says by stage how many are `held` in the buffer, and their mean `success` and
      `score`.
    """
    return [
        {"update": row["update"], "seed": seed, **_entry(row, names), **_levels(row, names)}
        for row in rows
        if row["decision"] != STAYED
    ]


def _entry(row: dict, names: Sequence[str]) -> dict:
    """Says what was decided in an update, and by which figures."""
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
    """Says what was practised then, where there is a buffer of levels."""
    if "levels_held" not in row:
        return {}
    told = [row[f"levels_{key}"] for key in _OF_LEVELS]
    each = [dict(zip(_OF_LEVELS, of_stage, strict=True)) for of_stage in zip(*told, strict=True)]
    return {"levels": dict(zip(names, each, strict=True))}
