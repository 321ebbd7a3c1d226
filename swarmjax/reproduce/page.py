"""The report of a reproduction: one HTML file that needs nothing else, its figures and verdicts."""

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import iqm
from swarmjax.reproduce import claims, measures
from swarmjax.reproduce import rows as reproduce_rows
from swarmjax.reproduce.claims import ClaimVerdict
from swarmjax.reproduce.measures import NUMBER, PLACE, SHARE, Axis, Measure, Unit
from swarmjax.reproduce.rows import ARMS, EXPANDED, LAST, Reproduction

if TYPE_CHECKING:
    from swarmjax.reproduce.figures import Plot

PAGE, VERDICTS, FIGURES = "report.html", "verdicts.md", "figures"
_PAIR = ("curriculum", "baseline")
_STEADY_ARMS = (*_PAIR, "modern_curriculum", "modern_baseline")
_MARKS = {"reproduced": "yes", "not reproduced": "no", "undecidable": "open"}
_HELD = {True: "yes", False: "no", None: "open"}
_MET = {True: "met", False: "not met", None: "open"}
# Of the settings, what names files here or says how the work was cut up.
_UNSAID = ("out", "resume", "minutes")
_COLUMNS: dict[str, tuple[str, Unit]] = {
    "targets_reached": ("targets reached", SHARE),
    "all_reached": ("all reached", SHARE),
    "sensed_share": ("steps within infrared range", SHARE),
    "contacts_per_robot": ("contacts per robot", NUMBER),
    "return": ("return per robot (m)", NUMBER),
}


def write(out: Path) -> Path:
    """Writes the report of a reproduction beside its data.

    Args:
      out: directory of the reproduction, which gets `report.html`, `verdicts.md` and `figures/`.

    Returns:
      The page.

    Raises:
      ConfigError: If what a figure shows is missing or damaged, or nothing can be written.
    """
    data = reproduce_rows.read(out)
    from swarmjax.reproduce import (
        figures as reproduce_figures,
    )  # Matplotlib takes a second, which no refusal should

    figures = reproduce_figures.draw(data)
    verdicts = claims.judge(data)
    files = {f"{FIGURES}/{name}.png": png for name, png in figures.items()}
    files[VERDICTS] = claims.markdown(verdicts).encode()
    files[PAGE] = page(data, verdicts, reproduce_figures.PLOTS, figures).encode()
    try:
        (out / FIGURES).mkdir(exist_ok=True)
        for name, content in files.items():
            (out / name).write_bytes(content)
    except OSError as error:
        raise ConfigError(f"out is {out}, which cannot be written: {error.strerror}.") from None
    return out / PAGE


def page(
    data: Reproduction,
    verdicts: Sequence[ClaimVerdict],
    plots: "Sequence[Plot]",
    figures: Mapping[str, bytes],
) -> str:
    """Lays the page out.

    A policy of what it may load stands in it: its own style and figures, and nothing that runs.

    Args:
      data: of the reproduction.
      verdicts: on the paper's claims.
      plots: in the order of the page.
      figures: PNG files of those of them that could be drawn, by name.

    Returns:
      HTML in which everything that was read is escaped.
    """
    files = resources.files("swarmjax.reproduce") / "templates"
    style = (files / "reproduce.css").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    shown = {
        section: "".join(_figure(data, plot, figures) for plot in plots if plot.section == section)
        for section in dict.fromkeys(plot.section for plot in plots)
    }
    return Template((files / "reproduce.html").read_text(encoding="utf-8")).substitute(
        policy=f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; "
        "base-uri 'none'; form-action 'none'",
        style=style,
        seeds=len(data.seeds),
        facts="".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>\n" for k, v in facts(data)),
        lacking=_lacking(data),
        counts=_counts(verdicts),
        arms=_arms(data),
        verdicts=_verdicts(verdicts),
        criteria=_criteria(verdicts),
        final=_final(data) + shown["final"],
        steady=escape(_steady_is()),
        figure6=shown["6"] + _steady(data),
        figure7=shown["7"],
        figure8=shown["8"],
        figure9=shown["9"] + _expanded(data),
        modern=_goals(data) + shown["modern"],
    )


def facts(data: Reproduction) -> list[tuple[str, str]]:
    """Says how the data came about: what, and the words for it, a line each."""
    found = data.facts
    return [
        ("made by", command(found["settings"])),
        ("seeds", f"{len(data.seeds)}: {', '.join(map(str, data.seeds))}"),
        (
            "budget",
            f"{found['budget']:,} arena control steps of each seed; at 1.5 m "
            f"{found['fine_tune']:,} more",
        ),
        ("commit", ", ".join(dict.fromkeys(map(_known, found["commit"].values())))),
        ("versions", ", ".join(f"{name} {of}" for name, of in found["versions"].items())),
    ]


def command(settings: Mapping[str, Any]) -> str:
    """Writes the command of a reproduction, without what names files or cuts the work up."""
    words = [f"{key}={_word(value)}" for key, value in _flat(settings) if key not in _UNSAID]
    return " ".join(["python -m swarmjax.reproduce", *words])


def _flat(settings: Mapping[str, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    """Names settings within settings by their whole path; those that are null are left out."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key}.")
        elif value is not None:
            yield f"{before}{key}", value


def _word(value: object) -> str:
    """Writes a value as the command line takes it."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_word, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _arms(data: Reproduction) -> str:
    """Tables the arms: what they are, and how long they took."""
    rows = []
    for arm, words in ARMS.items():
        made = ("not trained to the end", "", "")
        if arm in data.logs:
            times = [_seconds(data.facts[key].get(arm)) for key in ("seconds", "compile_s")]
            made = (*times, _known(data.facts["device"].get(arm)))
        rows.append((arm, words, *made))
    return _table(("arm", "what it is", "trained in", "compiled in", "on"), rows)


def _known(value: str | None) -> str:
    return value or "unknown"


def _seconds(value: float | None) -> str:
    return "unknown" if value is None else f"{value:,.0f} s"


def _lacking(data: Reproduction) -> str:
    """Says which arms have not finished."""
    missing = data.lacking(list(ARMS))
    if not missing:
        return ""
    text = f"Not trained to the end, and missing below: {', '.join(missing)}."
    return f'<p class="lacking">{escape(text)}</p>\n'


def _counts(verdicts: Sequence[ClaimVerdict]) -> str:
    """Says how many claims came to what."""
    found = [each.outcome for each in verdicts]
    counts = ", ".join(f"{found.count(outcome)} {outcome}" for outcome in _MARKS)
    return f"Of {len(found)} claims: {counts}."


def _verdicts(verdicts: Sequence[ClaimVerdict]) -> str:
    """Tables the verdicts, with the numbers that say so."""
    rows = []
    for each in verdicts:
        claim = each.claim
        because = "".join(
            f'<li>{escape(f.reading)}: {escape(f.text)} <span class="outcome {_HELD[f.holds]}">'
            f"{claims.HELD[f.holds]}</span></li>"
            for f in each.findings
        )
        rows.append(
            f"<tr><td><blockquote>{escape(claim.quote)}</blockquote>"
            f'<p class="where">{escape(claim.where)}</p></td>'
            f'<td><span class="outcome {_MARKS[each.outcome]}">{each.outcome}</span>'
            f'<p class="where">{each.reason}</p></td>'
            f"<td><ul>{because}</ul></td><td>{escape(claim.figures)}</td></tr>\n"
        )
    heads = _heads(("the paper says", "verdict", "because", "shown in"))
    return f'<div class="scroll"><table class="verdicts">\n{heads}{"".join(rows)}</table></div>\n'


def _criteria(verdicts: Sequence[ClaimVerdict]) -> str:
    """Lists what would bear each claim out."""
    lines = [
        f"<dt>{escape(each.claim.name)}</dt><dd>&ldquo;{escape(each.claim.quote)}&rdquo;: "
        f"{escape(each.claim.criterion)}</dd>\n"
        for each in verdicts
    ]
    return f"<dl>\n{''.join(lines)}</dl>\n"


def _figure(data: Reproduction, plot: "Plot", figures: Mapping[str, bytes]) -> str:
    """Embeds a figure, or says why there is none; and which arms it lacks."""
    missing = data.lacking(plot.arms)
    lacks = f"Lacks {' and '.join(missing)}, not trained to the end." if missing else ""
    if plot.name not in figures:
        text = f"Not drawn: {plot.caption.partition(':')[0]}. {lacks}"
        return f'<p class="lacking">{escape(text)}</p>\n'
    source = base64.b64encode(figures[plot.name]).decode("ascii")
    caption = escape(f"{plot.caption} {lacks}".strip())
    return (
        f'<figure id="{plot.name}"><img src="data:image/png;base64,{source}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>\n"
    )


def _final(data: Reproduction) -> str:
    """Tables what final policies came to, each arm on each stage."""
    rows = [
        (arm, stage, *_judged(data, arm, stage)) for arm in data.logs for stage in (LAST, EXPANDED)
    ]
    return _table(("arm", "on", *(label for label, _ in _COLUMNS.values())), rows)


def _judged(data: Reproduction, arm: str, stage: str) -> list[str]:
    """Writes each measure of an arm's final policies on a stage, with its interval."""
    found = data.judged[arm, stage]
    return [_mean(found[key], unit) for key, (_, unit) in _COLUMNS.items()]


def _mean(values: np.ndarray, unit: Unit) -> str:
    return unit.interval(statistics.bootstrap(values[:, None], iqm))


def _steady_is() -> str:
    """Defines the steady episode."""
    return (
        f"Success is steady from the first episode from which on {measures.WINDOW} episodes, and "
        f"all to the end of the run, have at least {100 * measures.STEADY:.0f} % of successes, and "
        f"no later {measures.WINDOW} less than {100 * measures.KEPT:.0f} %. A seed without such an "
        "episode never gets there, which sorts after every number: an IQM is never if more than a "
        "quarter of the seeds are."
    )


def _cases() -> list[tuple[str, Measure, Axis, str | None]]:
    """Both readings of success, over all episodes and over those on the last stage."""
    axes: list[tuple[Axis, str | None]] = [("episode", None), ("steps", LAST)]
    return [
        (name, success, axis, stage)
        for axis, stage in axes
        for name, success in measures.SUCCESS.items()
    ]


def _counted(axis: Axis, stage: str | None) -> str:
    """Names what a steady place is counted in."""
    episodes = "all episodes" if stage is None else f"episodes on {stage}"
    return f"{episodes}, {'episode number' if axis == 'episode' else 'arena steps'}"


def _steady(data: Reproduction) -> str:
    """Tables where success becomes steady: each arm, the two compared, and each seed."""
    arms = [arm for arm in _STEADY_ARMS if arm in data.logs]
    places = {
        (arm, i): measures.steady_at(data, arm, success=success, axis=axis, stage=stage)
        for arm in arms
        for i, (_, success, axis, stage) in enumerate(_cases())
    }
    heads = ("goal", "counted in", "arm", "median", "IQM", "seeds that get there")
    rows = [
        (name, _counted(axis, stage), arm, *_summary(places[arm, i]))
        for i, (name, _, axis, stage) in enumerate(_cases())
        for arm in arms
    ]
    text = f"<h3>Where success becomes steady</h3>\n{_table(heads, rows)}"
    if not data.lacking(_PAIR):
        text += f"<h3>Curriculum against baseline</h3>\n{_compared(places)}"
    heads = ("goal", "counted in", "arm", *(f"seed {seed}" for seed in data.seeds))
    rows = [
        (name, _counted(axis, stage), arm, *map(PLACE.value, places[arm, i]))
        for i, (name, _, axis, stage) in enumerate(_cases())
        for arm in arms
    ]
    return f"{text}<details><summary>Each seed</summary>\n{_table(heads, rows)}</details>\n"


def _summary(places: np.ndarray) -> tuple[str, str, str]:
    """Median, IQM and number of the seeds that get there, of places that may be inf."""
    there = np.isfinite(places)
    return (
        PLACE.value(float(np.median(places))),
        _mean(places, PLACE),
        # No bootstrap here: of ten seeds that all get there it would make 100 to 100 %.
        f"{there.sum()} of {len(places)}",
    )


def _compared(places: Mapping[tuple[str, int], np.ndarray]) -> str:
    """Tables how much earlier the curriculum is steady, seeds paired, and how likely unpaired."""
    rows = []
    for i, (name, _, axis, stage) in enumerate(_cases()):
        ours, theirs = places["curriculum", i], places["baseline", i]
        paired = "a seed never gets there"
        if np.isfinite([ours, theirs]).all():
            found = statistics.paired(theirs[:, None], ours[:, None], iqm)
            paired = PLACE.difference(found)
        chance = statistics.probability_of_improvement(theirs[:, None], ours[:, None])
        rows.append((name, _counted(axis, stage), paired, NUMBER.interval(chance)))
    heads = (
        "goal",
        "counted in",
        "curriculum minus baseline, seeds paired",
        "probability that a seed of the curriculum is earlier",
    )
    note = (
        "Below 0, and above 0.5, the curriculum is earlier. Pairs are runs of the same seed; the "
        "probability takes any seed of one with any of the other."
    )
    return f"<p>{note}</p>\n{_table(heads, rows)}"


def _expanded(data: Reproduction) -> str:
    """Tables the share of targets at 1.5 m, as they are and trained on."""
    rows = []
    for kind, suffix in (("zero-shot", ""), ("trained on", "_expanded")):
        for arm in _PAIR:
            name = f"{arm}{suffix}"
            if name in data.logs:
                found = data.judged[name, EXPANDED]
                shares = (found["targets_reached"], found["all_reached"])
                rows.append((kind, arm, *(_mean(each, SHARE) for each in shares)))
    heads = ("at 1.5 m", "arm", "targets reached", "all reached")
    return _table(heads, rows) if rows else ""


def _goals(data: Reproduction) -> str:
    """Tables this project's own goals for the default trainer."""
    rows = [(goal.reading, goal.text, _MET[goal.holds]) for goal in claims.goals(data)]
    note = (
        "This project's goals, beyond the paper: met where the whole interval is, not met where "
        "none of it is."
    )
    return f"<p>{note}</p>\n{_table(('goal', 'targets reached', 'verdict'), rows)}"


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Makes a table that scrolls sideways by itself."""
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>\n" for row in rows
    )
    return f'<div class="scroll"><table class="numbers">\n{_heads(heads)}{body}</table></div>\n'


def _heads(heads: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<th>{escape(text)}</th>' for text in heads)}</tr>\n"
