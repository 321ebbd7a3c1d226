"""Builds the page of a report: one self-contained HTML file that includes its figures."""

import os.path
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax import command, words
from swarmjax.config import files, to_dict
from swarmjax.pages import builder
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import History, Row

STYLES = (builder.STYLE, "report/report.css")


def page(
    title: str,
    command: str,
    history: History,
    figures: Mapping[str, bytes],
    replay: tuple[str, str] = ("", ""),
    template: str = "report/report.html",
    **values: Any,
) -> str:
    """Lays out the page.

    Args:
      title: title of the page, which names the run.
      command: the command that makes the report.
      history: the run's history.
      figures: PNG files, by the names that their captions have in `captions.html`.
      replay: the address of the run's replay, and the command that writes the replay; empty texts
        if there is none.
      template: the template of the page; it extends `report.html`.
      values: further values for the template.

    Returns:
      HTML with every name from the run escaped.
    """
    return builder.render(
        template,
        styles=STYLES,
        title=title,
        command=command,
        about=_facts(history),
        is_wide=len(history.names) > report_rows.MANY,
        figures=figures,
        replay=replay,
        decisions=_decisions(history),
        reweighed=words.count(sum("weights" in row for row in history.decisions), "time"),
        stages=_stages(history),
        **values,
    )


def _facts(history: History) -> list[tuple[str, str]]:
    """Returns heading and text of each line about a run: two about results, then its settings."""
    trained, names, seeds = history.config, history.labels, history.seeds
    spent = f"{history.updates[-1] + 1:,} of {words.count(trained.updates, 'update')}"
    spent += " (run.stop_at is reached)" if history.has_reached else ""
    time = "" if history.seconds is None else f", {words.duration(history.seconds)}"
    steps = f"{history.arena_steps[-1]:,} arena control steps per seed"
    options = files.flatten(to_dict(trained.curriculum))
    given = ", ".join(f"{key}={value}" for key, value in options.items() if value is not None)
    axes = f"; by {' · '.join(trained.curriculum.axes)}" if trained.curriculum.axes else ""
    stages = [("stages", f"{len(names)}: {names[0]} to {names[-1]}{axes}"), ("curriculum", given)]
    return [
        ("last stage", _last_stage(history)),
        ("trained", f"{spent}, {steps}, {words.count(trained.arenas, 'arena')}{time}"),
        *(stages if len(names) > 1 else []),
        ("seeds", f"{seeds[0]}" + (f" to {seeds[-1]}" if len(seeds) > 1 else "")),
        ("computed by", _origin(history.summary)),
    ]


def replay(run: Path, out: Path | None = None) -> tuple[str, str]:
    """Finds the replay of a run.

    Args:
      run: the run directory.
      out: directory of the page that links to the replay; None if the page is not a file.

    Returns:
      The replay's address relative to `out`, and the command that writes the replay. The address
      is empty if there is no replay yet or `out` is None. The command is empty if the run has no
      policy yet.
    """
    film, policies = run / "replay.html", sorted(run.glob("policy*.npz"))
    address = os.path.relpath(film, out) if out and film.exists() else ""
    how = command.line("replay", f"policy={policies[0]}", f"out={film}") if policies else ""
    return address, how


def _last_stage(history: History) -> str:
    """Writes the success of the last stage: interquartile mean and range over seeds."""
    values = history.success[:, -1, -1]
    (mean,), (measured,) = report_rows.among(values[:, None])
    if not measured:
        return "not measured: too little training on this stage so far"
    text = f"{history.names[-1]}: {report_rows.measure(history)} {_percent(mean)}"
    if len(history.seeds) == 1:
        return text
    low, high = np.nanmin(values), np.nanmax(values)
    return (
        f"{text} (interquartile mean of {measured} of {len(history.seeds)} seeds, {_percent(low)} "
        f"to {_percent(high)})"
    )


def _origin(summary: Row) -> str:
    """Names the device that computed a run, and the commit of the code."""
    if not summary:
        return "not recorded before the end of the run"
    return f"{summary.get('device')}, commit {summary.get('commit') or 'unknown'}"


def _decisions(history: History) -> list[tuple]:
    """Returns the rows of the table of promotions."""
    step = history.config.arenas * history.config.algo.rollout_length
    shares = ("targets_reached", "all_reached")
    return [
        (
            row["seed"],
            f"{row['update'] + 1:,}",
            f"{(row['update'] + 1) * step:,}",
            *(row.get(key) for key in ("from", "to", "why")),
            *(_percent(row.get(key)) for key in shares),
        )
        for row in history.decisions
        if "weights" not in row
    ]


def _stages(history: History) -> list[tuple]:
    """Returns the rows of the table of stages: settings, share of the training, last results."""
    last = {key: report_rows.among(values[:, -1]) for key, values in history.by_stage.items()}
    share = history.mix.mean(axis=(0, 1))
    return [
        (
            stage.name,
            stage.robots,
            words.setting(stage.distance),
            stage.obstacles,
            words.setting(stage.side),
            _percent(share[i]),
            *(_percent(last[f"{key}_by_stage"][0][i]) for key in ("success", "complete")),
            *(_number(last[f"{key}_by_stage"][0][i]) for key in ("contacts", "return")),
            f"{last['success_by_stage'][1][i]} of {len(history.seeds)}",
        )
        for i, stage in enumerate(history.config.stage)
    ]


def _percent(share: float | None) -> str | None:
    """Writes a share as a percentage. Returns None if the share is None or nan."""
    return None if share is None or np.isnan(share) else f"{100.0 * share:.1f} %"


def _number(value: float) -> str | None:
    return None if np.isnan(value) else f"{value:.3g}"
