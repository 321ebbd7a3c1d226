"""Builds the report of a reproduction: one self-contained HTML file with figures and verdicts."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from swarmjax import command
from swarmjax.config import files, to_dict
from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import iqm
from swarmjax.pages import builder
from swarmjax.reproduce import claims, measures
from swarmjax.reproduce import rows as reproduce_rows
from swarmjax.reproduce.config import BUDGET, FINE_TUNE
from swarmjax.reproduce.measures import FINAL, PLACE, Unit
from swarmjax.reproduce.rows import ARMS, LAST, MODERN, PAIR, Reproduction

PAGE, FIGURES = "report.html", "figures"
# Both readings of success, each over all episodes and over the episodes on the last stage.
_CASES = (*claims.steady(None, "episode"), *claims.steady(LAST, "steps"))
_OUTCOMES = ("reproduced", "not reproduced", "undecidable")


def write(out: Path) -> Path:
    """Writes the report of a reproduction next to its data.

    Args:
      out: directory of the reproduction; gets `report.html` and `figures/`.

    Returns:
      Path of the page.

    Raises:
      ConfigError: if data for a figure are missing or damaged, or a file cannot be written.
    """
    data = reproduce_rows.read(out)
    # Importing Matplotlib takes a second. Errors above should come without that delay.
    from swarmjax.reproduce import figures as reproduce_figures

    figures = reproduce_figures.png_files(data)
    lacks = {name: data.lacking(plot.arms) for name, plot in reproduce_figures.PLOTS.items()}
    content = {f"{FIGURES}/{name}.png": png for name, png in figures.items()}
    content[PAGE] = _page(data, figures, lacks).encode()
    return builder.write(out, content)[-1]


def _page(
    data: Reproduction, figures: Mapping[str, bytes], lacks: Mapping[str, Sequence[str]]
) -> str:
    """Lays out the page from its PNG files, and says for each figure which arms it lacks."""
    verdicts = [claims.verdict(data, claim) for claim in claims.CLAIMS]
    outcomes = [each.outcome for each in verdicts]
    places = [
        (goal, counted, arm, values(data, arm))
        for goal, counted, values in _CASES
        for arm in (*PAIR, *MODERN)
        if arm in data.logs
    ]
    settings = to_dict(replace(data.settings, out=None, resume=None, minutes=None))
    given = {key: value for key, value in settings.items() if value is not None}
    return builder.render(
        "reproduce/reproduce.html",
        paper_budget=BUDGET,
        paper_fine_tune=FINE_TUNE,
        styles=(builder.STYLE, "reproduce/reproduce.css"),
        title="The published experiment, reproduced",
        data=data,
        made_by=command.line("reproduce", *files.write_words(given)),
        lacking=data.lacking(ARMS),
        verdicts=verdicts,
        counts=", ".join(f"{outcomes.count(name)} {name}" for name in _OUTCOMES),
        held=claims.HELD,
        last=LAST,
        figures=figures,
        lacks=lacks,
        final_heads=("arm", "on", "actions", *(label for label, _ in FINAL.values())),
        final=[
            (*where, *(_mean(values[key], unit) for key, (_, unit) in FINAL.items()))
            for where, values in data.judged.items()
        ],
        window=measures.WINDOW,
        steady_share=100 * measures.STEADY,
        kept_share=100 * measures.KEPT,
        steady=[(*case, *_summary(of_seeds)) for *case, of_seeds in places],
    )


def _mean(values: np.ndarray, unit: Unit) -> str:
    return unit.interval(statistics.bootstrap(values[:, None], iqm))


def _summary(places: np.ndarray) -> tuple[str, str, str]:
    """Writes the median and interquartile mean of steps or episodes, and how many seeds have one.

    A seed without one has inf.
    """
    return (
        PLACE.value(float(np.median(places))),
        _mean(places, PLACE),
        # No bootstrap interval: if all ten seeds became steady, it would be 100 to 100 %.
        f"{np.isfinite(places).sum()} of {len(places)}",
    )
