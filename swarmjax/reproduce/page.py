"""Builds the report of a reproduction: one self-contained HTML file with figures and verdicts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import iqm
from swarmjax.pages import builder
from swarmjax.reproduce import claims, measures
from swarmjax.reproduce import rows as reproduce_rows
from swarmjax.reproduce.claims import ClaimVerdict
from swarmjax.reproduce.measures import NUMBER, PLACE, SHARE, Unit
from swarmjax.reproduce.rows import ARMS, EXPANDED, LAST, MODERN, PAIR, Reproduction
from swarmjax.run.load_settings import leaves

PAGE, VERDICTS, FIGURES = "report.html", "verdicts.md", "figures"
# Both readings of success, over all episodes and over those on the last stage.
_CASES = (*claims.steady(None, "episode"), *claims.steady(LAST, "steps"))
_OUTCOMES = ("reproduced", "not reproduced", "undecidable")
_MET = {True: "met", False: "not met", None: "open"}
# Settings that only name local files or split the work; the printed command leaves them out.
_UNSAID = ("out", "resume", "minutes")
_COLUMNS: dict[str, tuple[str, Unit]] = {
    "targets_reached": ("targets reached", SHARE),
    "all_reached": ("all reached", SHARE),
    "sensed_share": ("steps within infrared range", SHARE),
    "contacts_per_robot": ("contacts per robot", NUMBER),
    "return": ("return per robot (m)", NUMBER),
}


def write(out: Path) -> Path:
    """Writes the report of a reproduction next to its data.

    Args:
      out: directory of the reproduction; gets `report.html`, `verdicts.md` and `figures/`.

    Returns:
      Path of the page.

    Raises:
      ConfigError: if data for a figure are missing or damaged, or a file cannot be written.
    """
    data = reproduce_rows.read(out)
    # Importing Matplotlib takes a second. Errors above should come without that delay.
    from swarmjax.reproduce import figures as reproduce_figures

    figures = reproduce_figures.draw(data)
    verdicts = claims.judge(data)
    lacks = {name: data.lacking(plot.arms) for name, plot in reproduce_figures.PLOTS.items()}
    files = {f"{FIGURES}/{name}.png": png for name, png in figures.items()}
    files[VERDICTS] = claims.markdown(verdicts).encode()
    files[PAGE] = _page(data, verdicts, figures, lacks).encode()
    return builder.write(out, files, overwrite=True)[-1]


def _page(
    data: Reproduction,
    verdicts: Sequence[ClaimVerdict],
    figures: Mapping[str, bytes],
    lacks: Mapping[str, Sequence[str]],
) -> str:
    """Lays out the page, from PNG files by name and the arms that each figure lacks."""
    places = _places(data)
    outcomes = [each.outcome for each in verdicts]
    return builder.render(
        "reproduce/reproduce.html",
        styles=(builder.STYLE, "reproduce/reproduce.css"),
        title="The published experiment, reproduced",
        seeds=len(data.seeds),
        seed_heads=[f"seed {seed}" for seed in data.seeds],
        about=facts(data),
        lacking=data.lacking(list(ARMS)),
        arms=_arms(data),
        verdicts=verdicts,
        counts=", ".join(f"{outcomes.count(name)} {name}" for name in _OUTCOMES),
        held=claims.HELD,
        last=LAST,
        expanded_stage=EXPANDED,
        figures=figures,
        lacks=lacks,
        final_heads=("arm", "on", *(label for label, _ in _COLUMNS.values())),
        final=_final(data),
        window=measures.WINDOW,
        steady_share=100 * measures.STEADY,
        kept_share=100 * measures.KEPT,
        steady=[(*case, *_summary(found)) for *case, found in places],
        each_seed=[(*case, *map(PLACE.value, found)) for *case, found in places],
        compared=[] if data.lacking(PAIR) else _compared(data),
        expanded=_expanded(data),
        goals=[(goal.reading, goal.text, _MET[goal.holds]) for goal in claims.goals(data)],
    )


def facts(data: Reproduction) -> list[tuple[str, str]]:
    """States how the data were made, one fact per line: its heading and its text."""
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
    """Writes the command of a reproduction, without settings that name files or split the work."""
    words = (
        f"{key}={_word(value)}"
        for key, value in leaves(settings).items()
        if value is not None and key not in _UNSAID
    )
    return " ".join(["python -m swarmjax.reproduce", *words])


def _word(value: object) -> str:
    """Writes a value as the command line takes it."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_word, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _arms(data: Reproduction) -> list[tuple[str, ...]]:
    """Makes the table of the arms: what they are, and how long they took."""
    rows = []
    for arm, words in ARMS.items():
        made = ("not trained to the end", "", "")
        if arm in data.logs:
            times = [_seconds(data.facts[key].get(arm)) for key in ("seconds", "compile_s")]
            made = (*times, _known(data.facts["device"].get(arm)))
        rows.append((arm, words, *made))
    return rows


def _known(value: str | None) -> str:
    return value or "unknown"


def _seconds(value: float | None) -> str:
    return "unknown" if value is None else f"{value:,.0f} s"


def _final(data: Reproduction) -> list[tuple[str, ...]]:
    """Makes the table of the final policies' results, for each arm on each stage."""
    return [
        (arm, stage, *_judged(data, arm, stage)) for arm in data.logs for stage in (LAST, EXPANDED)
    ]


def _judged(data: Reproduction, arm: str, stage: str) -> list[str]:
    """Writes each measure of an arm's final policies on a stage, with its interval."""
    found = data.judged[arm, stage]
    return [_mean(found[key], unit) for key, (_, unit) in _COLUMNS.items()]


def _mean(values: np.ndarray, unit: Unit) -> str:
    return unit.interval(statistics.bootstrap(values[:, None], iqm))


def _places(data: Reproduction) -> list[tuple[str, str, str, np.ndarray]]:
    """Lists goal, axis and arm, and where each of the arm's seeds [N] becomes steady."""
    arms = [arm for arm in (*PAIR, *MODERN) if arm in data.logs]
    return [(goal, of, arm, values(data, arm)) for goal, of, values in _CASES for arm in arms]


def _summary(places: np.ndarray) -> tuple[str, str, str]:
    """Writes median and IQM of places, and how many seeds have a place; inf means none."""
    there = np.isfinite(places)
    return (
        PLACE.value(float(np.median(places))),
        _mean(places, PLACE),
        # No bootstrap: if all ten seeds become steady, its interval would be 100 to 100 %.
        f"{there.sum()} of {len(places)}",
    )


def _compared(data: Reproduction) -> list[tuple[str, ...]]:
    """Makes the table of how much earlier success becomes steady with the curriculum.

    The table gives the difference of paired seeds, and the probability for unpaired ones.
    """
    rows = []
    for goal, counted, values in _CASES:
        ours, theirs = (values(data, arm)[:, None] for arm in PAIR)
        paired = "a seed never gets there"
        if np.isfinite([ours, theirs]).all():
            paired = PLACE.difference(statistics.paired(theirs, ours, iqm))
        chance = statistics.probability_of_improvement(theirs, ours)
        rows.append((goal, counted, paired, NUMBER.interval(chance)))
    return rows


def _expanded(data: Reproduction) -> list[tuple[str, ...]]:
    """Makes the table of the share of targets at 1.5 m, zero-shot and trained on."""
    kinds = (("zero-shot", ""), ("trained on", "_expanded"))
    shares = ("targets_reached", "all_reached")
    return [
        (kind, arm, *(_mean(data.judged[f"{arm}{suffix}", EXPANDED][key], SHARE) for key in shares))
        for kind, suffix in kinds
        for arm in PAIR
        if f"{arm}{suffix}" in data.logs
    ]
