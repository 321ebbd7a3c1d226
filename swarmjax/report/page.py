"""The page of a report: one HTML file that needs nothing else, with its figures inside."""

import base64
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from swarmjax import words
from swarmjax.config import to_dict
from swarmjax.report import rows as report_rows
from swarmjax.report import table as report_table
from swarmjax.report.rows import History, Row
from swarmjax.report.table import TableLine

GOOD = 0.9  # success from which on a stage is counted as learned
_TOP = 5  # stages named of a reweighing

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; margin: 1.2rem auto;
       max-width: 1500px; padding: 0 1.2rem; }
h1 { font-size: 1.35rem; margin: 0 0 .6rem; overflow-wrap: anywhere; }
h2 { font-size: 1.05rem; margin: 1.4rem 0 .4rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: 0; }
dt { color: #555; } dd { margin: 0; overflow-wrap: anywhere; }
.figures { display: grid; gap: 1rem;
           grid-template-columns: repeat(auto-fit, minmax(min(480px, 100%), 1fr)); }
.wide { grid-template-columns: 1fr; }
figure { margin: 1rem 0 0; } img { max-width: 100%; } figcaption { color: #444; }
.scroll { max-height: 26rem; overflow: auto; border: 1px solid #ddd; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { position: sticky; top: 0; background: #f2f2f2; text-align: left; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid #eee; vertical-align: top; }
code { background: #f2f2f2; padding: 0 .2rem; }
"""

_CAPTIONS = {
    "mix": "On which stages the arenas were.",
    "success": "Success of each stage: the share of a whole cohort, all episodes that began within "
    "one step limit. Above each panel the last one; the thick line is drawn where every seed has "
    "one.",
    "curves": "How learning went, at each update. Return and contacts are sums over an episode and "
    "means over the robots of the episodes that ended in the update; short episodes end first, so "
    "the first ones say little. Entropy is that of the policy's actions, in nats.",
    "levels": "What the curriculum over levels did: how many levels of each stage are kept, how "
    "many episodes began on one of them, and how those went.",
    "practised": "The levels of each stage with the highest scores, as the newest checkpoint of "
    "the first seed has them: success over the episodes that are remembered, and the score. Robots "
    "are discs, their targets circles of the same colour.",
    "grid": "Success of each cell at last, in percent; grey: not a stage of this run.",
}


def page(title: str, command: str, history: History, figures: Mapping[str, bytes]) -> str:
    """Lays the page out.

    Args:
      title: names the run.
      command: that makes the report.
      history: of the run.
      figures: PNG files by the names of `_CAPTIONS`.

    Returns:
      HTML in which every name of a run is escaped.
    """
    name = escape(title)
    layout = "figures" if len(history.names) <= report_rows.MANY else "figures wide"
    told = "".join(
        f"<dt>{escape(what)}</dt><dd>{escape(text)}</dd>\n" for what, text in facts(history)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{name}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<h1>{name}</h1>\n"
        f"<dl>\n{told}<dt>made by</dt><dd><code>{escape(command)}</code></dd>\n</dl>\n"
        f'<div class="{layout}">\n{"".join(_figure(*each) for each in figures.items())}</div>\n'
        f"<h2>Decisions of the curriculum</h2>\n{_decisions(history)}"
        f"<h2>Stages</h2>\n{_stages(history)}</body>\n</html>\n"
    )


def table_page(title: str, command: str, lines: Sequence[TableLine]) -> str:
    """Lays the table of several runs out.

    Args:
      title: of the page.
      command: that makes the report.
      lines: of the table.

    Returns:
      HTML in which every name of a run is escaped.
    """
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n{_table(report_table.HEADS, report_table.cells(lines))}"
        f"<p>{escape(report_table.note(lines))} Made by <code>{escape(command)}</code>.</p>\n"
        "</body>\n</html>\n"
    )


def facts(history: History) -> list[tuple[str, str]]:
    """Says what the run is and what came of it, a line each.

    Args:
      history: of the run.

    Returns:
      What a line is about, and its text.
    """
    trained, names = history.config, history.names
    stages_by = to_dict(trained.curriculum)
    levels_by = stages_by.pop("levels")
    options = [*stages_by.items(), *((f"levels.{key}", value) for key, value in levels_by.items())]
    seeds = f"{history.seeds[0]}" + (f" to {history.seeds[-1]}" if len(history.seeds) > 1 else "")
    spent = f"{history.updates[-1] + 1:,} of {words.count(trained.updates, 'update')}"
    time = "" if history.seconds is None else f", {words.duration(history.seconds)}"
    stages = f"{len(names)}: {names[0]} to {names[-1]}" if len(names) > 1 else f"1: {names[0]}"
    return [
        ("stages", stages),
        (
            "curriculum",
            ", ".join(f"{key}={value}" for key, value in options if value is not None),
        ),
        ("seeds", seeds),
        (
            "trained",
            f"{spent}, {history.arena_steps[-1]:,} arena control steps of a seed, "
            f"{words.count(trained.arenas, 'arena')}{time}",
        ),
        ("last stage", _last_stage(history)),
        ("all stages", _all_stages(history)),
        ("decisions", _counted(history.decisions)),
        ("computed by", _origin(history.summary)),
    ]


def _last_stage(history: History) -> str:
    """Says how the last stage stands: interquartile mean and range over seeds."""
    values = history.success[:, -1, -1]
    mean, measured = report_rows.among(values[:, None])
    name, of = history.names[-1], len(history.seeds)
    if not measured[0]:
        return f"{name}: {_unmeasured(history)}"
    text = f"{name}: {report_rows.measure(history)} {_percent(mean[0])}"
    if of == 1:
        return text
    low, high = np.nanmin(values), np.nanmax(values)
    return (
        f"{text} (interquartile mean of {measured[0]} of {of} seeds, {_percent(low)} to "
        f"{_percent(high)})"
    )


def _unmeasured(history: History) -> str:
    """Says why the last stage has no figure."""
    trained = int((history.mix[..., -1] > 0.0).sum(axis=1).max())
    if not trained:
        return "not measured, since no arena has been on it"
    takes = words.count(report_rows.verdict_updates(history), "update")
    return (
        f"not measured, since no whole cohort has ended on it: that takes {takes}, and arenas were "
        f"on it for {trained:,}"
    )


def _all_stages(history: History) -> str:
    """Says how many stages are learned, and which is the worst."""
    mean, measured = report_rows.among(history.success[:, -1])
    good = int((mean >= GOOD).sum())
    text = f"{good} of {len(mean)} at {_percent(GOOD)} or more"
    if not measured.any():
        return text
    worst = int(np.nanargmin(mean))
    rest = int((measured == 0).sum())
    return f"{text}; lowest {history.names[worst]} with {_percent(mean[worst])}" + (
        f"; {rest} not measured" if rest else ""
    )


def _counted(decisions: Sequence[Row]) -> str:
    """Counts decisions by their reason."""
    reasons = Counter(str(row.get("why")) for row in decisions)
    return ", ".join(f"{count:,} by {why}" for why, count in reasons.items()) or "none"


def _origin(summary: Row) -> str:
    """Says on what a run was computed, by which commit."""
    if not summary:
        return "not written down before the end of the run"
    return f"{summary.get('device')}, commit {summary.get('commit') or 'unknown'}"


def _figure(name: str, png: bytes) -> str:
    """Embeds a figure."""
    data = base64.b64encode(png).decode("ascii")
    caption = _CAPTIONS[name]
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{escape(caption)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>\n"
    )


def _decisions(history: History) -> str:
    """Tables promotions and demotions, and of the reweighings of a seed their number and last."""
    step = history.config.arenas * history.config.algo.rollout_length
    rows = [
        (
            row["seed"],
            f"{row['update'] + 1:,}",
            f"{(row['update'] + 1) * step:,}",
            row.get("from"),
            row.get("to"),
            row.get("why"),
            _percent(row.get("targets_reached")),
            _percent(row.get("all_reached")),
        )
        for row in history.decisions
        if "weights" not in row
    ]
    heads = (
        "seed",
        "updates done",
        "arena control steps",
        "from",
        "to",
        "why",
        "targets reached",
        "all reached",
    )
    tables = (_table(heads, rows) if rows else "") + _reweighings(history)
    return tables or "<p>None.</p>\n"


def _reweighings(history: History) -> str:
    """Says how often the arenas of each seed were spread anew, and how they were at last."""
    by_seed: dict[int, list[Row]] = {}
    for row in history.decisions:
        if "weights" in row:
            by_seed.setdefault(row["seed"], []).append(row)
    rows = []
    for seed, found in by_seed.items():
        weights = {name: share or 0.0 for name, share in found[-1]["weights"].items()}
        top = sorted(weights, key=lambda name: -weights[name])[:_TOP]
        most = ", ".join(f"{name} {_percent(weights[name])}" for name in top)
        rows.append((seed, len(found), f"{found[-1]['update'] + 1:,}", most))
    heads = ("seed", "times reweighed", "updates done at the last", "most arenas then on")
    return _table(heads, rows) if rows else ""


def _stages(history: History) -> str:
    """Tables the stages: what they are, how long they were trained on, and how they stand."""
    last = {key: report_rows.among(values[:, -1]) for key, values in history.by_stage.items()}
    share = history.mix.mean(axis=(0, 1))
    rows = [
        (
            stage.name,
            stage.robots,
            stage.obstacles,
            report_rows.side_text(stage.sides),
            _percent(share[i]),
            _percent(last["success_by_stage"][0][i]),
            _percent(last["complete_by_stage"][0][i]),
            _number(last["contacts_by_stage"][0][i]),
            _number(last["return_by_stage"][0][i]),
            f"{last['success_by_stage'][1][i]} of {len(history.seeds)}",
        )
        for i, stage in enumerate(history.config.stage)
    ]
    heads = (
        "stage",
        "robots",
        "obstacles",
        "side (m)",
        "share of training",
        "targets reached",
        "all reached",
        "contacts per robot",
        "return per robot",
        "seeds measured",
    )
    note = "Newest verdicts, as interquartile means of the seeds that have one."
    return f"<p>{note}</p>\n{_table(heads, rows)}"


def _table(heads: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Makes a table that scrolls by itself; None is a dash."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>\n" for row in rows)
    return f'<div class="scroll"><table>\n<tr>{head}</tr>\n{body}</table></div>\n'


def _cell(value: object) -> str:
    return f"<td>{'-' if value is None else escape(str(value))}</td>"


def _percent(share: float | None) -> str | None:
    """Writes a share; None where it is null or nan."""
    return None if share is None or np.isnan(share) else f"{100.0 * share:.1f} %"


def _number(value: float) -> str | None:
    return None if np.isnan(value) else f"{value:.3g}"
