"""Judges the claims in the paper's text with the data of a reproduction. No JAX.

The criteria that support or contradict a claim were fixed here before any data existed. A claim
has one reading for each way to understand the paper (docs/paper.md). Every number is an
interquartile mean over seeds with its 95 % bootstrap interval. A claim is reproduced if it holds
in all of its readings, and not reproduced if the data contradict all of them. It is undecidable if
an interval straddles the limit, readings disagree or an arm is missing.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from swarmjax.reproduce import measures
from swarmjax.reproduce.criteria import (
    about,
    above_zero,
    at_least,
    below,
    crowded,
    earlier,
    higher,
    lower,
)
from swarmjax.reproduce.measures import NUMBER, SHARE, Axis, Measure
from swarmjax.reproduce.rows import EXPANDED, LAST, MODERN, PAIR, TUNED, Reproduction

GENERATED = 0.8  # share of targets that counts as the desired behaviour; also promotes from a stage
FAILED = 0.5  # below this share of targets a swarm fails
_NOTE = (
    "Numbers are interquartile means over seeds, with 95 % bootstrap intervals in brackets. Of "
    "two, the first is the curriculum's and the second the baseline's."
)

type Outcome = Literal["reproduced", "not reproduced", "undecidable"]
# A function of the values [N] of a reading's arms: whether the claim holds, and the numbers.
type Test = Callable[..., tuple[bool | None, str]]
# The value of each seed of an arm, [N]: a function of `measures` with its options set.
type Values = Callable[[Reproduction, str], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One way to understand a claim.

    Attributes:
      name: name in words.
      arms: finished arms that the reading needs.
      values: takes the values of an arm.
      test: tests the values of the arms, in the order of `arms`.
    """

    name: str
    arms: tuple[str, ...]
    values: Values
    test: Test


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The result of a reading of a claim.

    Attributes:
      reading: name of the reading.
      holds: whether the claim holds in this reading; None if undecided.
      text: the numbers behind the result.
    """

    reading: str
    holds: bool | None
    text: str


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim in the paper's text.

    Attributes:
      name: key of the claim.
      quote: the paper's sentence, word for word.
      where: where the paper says it.
      criterion: what supports the claim, and what contradicts it.
      figures: figures and tables of the report that show it.
      readings: the readings; the claim must hold in all of them.
    """

    name: str
    quote: str
    where: str
    criterion: str
    figures: str
    readings: tuple[Reading, ...]

    @property
    def needs(self) -> tuple[str, ...]:
        """The arms that the readings need."""
        return tuple(dict.fromkeys(arm for reading in self.readings for arm in reading.arms))


@dataclass(frozen=True, kw_only=True)
class ClaimVerdict:
    """The verdict on a claim.

    Attributes:
      claim: the claim.
      outcome: the verdict.
      reason: why the claim is undecidable; empty if it is decided.
      findings: the results of the readings.
    """

    claim: Claim
    outcome: Outcome
    reason: str
    findings: tuple[Finding, ...]


def judge(data: Reproduction) -> list[ClaimVerdict]:
    """Judges every claim of the paper."""
    return [verdict(data, claim) for claim in CLAIMS]


def verdict(data: Reproduction, claim: Claim) -> ClaimVerdict:
    """Judges a claim by all of its readings."""
    findings = tuple(finding(data, reading) for reading in claim.readings)
    held = {each.holds for each in findings}
    outcome: Outcome = "undecidable"
    reason = ""
    if held == {True}:
        outcome = "reproduced"
    elif held == {False}:
        outcome = "not reproduced"
    elif data.lacking(claim.needs):
        reason = "an arm is missing"
    else:
        reason = "readings disagree" if {True, False} <= held else "a reading is open"
    return ClaimVerdict(claim=claim, outcome=outcome, reason=reason, findings=findings)


def finding(data: Reproduction, reading: Reading) -> Finding:
    """Evaluates a reading; it stays open if an arm or an episode is missing."""
    lacking = data.lacking(reading.arms)
    values = [] if lacking else [reading.values(data, arm) for arm in reading.arms]
    if lacking:
        holds, text = None, f"lacks {' and '.join(lacking)}"
    elif any(np.isnan(each).any() for each in values):
        holds, text = None, "a seed has too few episodes for it"
    else:
        holds, text = reading.test(*values)
    return Finding(reading=reading.name, holds=holds, text=text)


def goals(data: Reproduction) -> list[Finding]:
    """Tests whether the modern trainer meets this project's own goals, with mean actions."""
    return [finding(data, goal) for goal in GOALS]


def markdown(verdicts: Sequence[ClaimVerdict]) -> str:
    """Writes the verdicts as a Markdown table."""
    rows = []
    for each in verdicts:
        reason = f", {each.reason}" if each.reason else ""
        because = "<br>".join(f"{f.reading}: {f.text} ({HELD[f.holds]})" for f in each.findings)
        rows.append(
            f'| "{each.claim.quote}" | {each.claim.where} | **{each.outcome}**{reason} | '
            f"{because} | {each.claim.figures} |"
        )
    heads = ("the paper says", "where", "verdict", "because", "shown in")
    return "\n".join([f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *rows, "", _NOTE, ""])


HELD = {True: "holds", False: "contradicted", None: "open"}


def _by_mean(key: str, stage: str) -> tuple[str, Values]:
    """Makes a source of values: final policies that drive by their mean actions."""
    return "final policies, mean action", partial(measures.judged, key=key, stage=stage)


def _by_sampling(of: Measure, stage: str) -> tuple[str, Values]:
    """Makes a source of values: the end of training, with sampled actions."""
    name = f"last {measures.WINDOW} episodes of training on {stage}, sampled actions"
    return name, partial(measures.late, of=of, stage=stage)


def _called(what: str, sources: Iterable[tuple[str, Values]]) -> list[tuple[str, Values]]:
    """Puts the name of the quantity before the names of its sources."""
    return [(f"{what}, {name}", values) for name, values in sources]


def _readings(arms: tuple[str, ...], test: Test, *sources: tuple[str, Values]) -> tuple:
    """Makes one reading per source of values, all with the same arms and the same test."""
    return tuple(Reading(name=name, arms=arms, values=v, test=test) for name, v in sources)


def steady(stage: str | None, axis: Axis) -> list[tuple[str, str, Values]]:
    """Lists how to find where success becomes steady, for both readings of success.

    Args:
      stage: uses only the episodes of this stage; None for all.
      axis: unit in which places are counted.

    Returns:
      For each reading: the goal, what is counted, and a function that finds an arm's places by
      seed.
    """
    which = "all episodes" if stage is None else f"episodes on {stage}"
    counted = f"{which}, {measures.UNITS[axis]}"
    return [
        (goal, counted, partial(measures.steady_at, success=success, axis=axis, stage=stage))
        for goal, success in measures.SUCCESS.items()
    ]


def _steady(stage: str | None, axis: Axis) -> list[tuple[str, Values]]:
    return [(f"{goal}, {counted}", values) for goal, counted, values in steady(stage, axis)]


def _rewarded() -> tuple[tuple[str, Values], ...]:
    """Lists how to find where the last stage's reward nears its best, for robot 1 and the swarm."""
    kinds = {"robot 1": measures.first_reward, "mean of the robots": measures.mean_reward}
    return tuple(
        (
            f"{name}, {unit}",
            partial(measures.reward_reached, of=of, axis=axis, rivals=PAIR, stage=LAST),
        )
        for name, of in kinds.items()
        for axis, unit in measures.UNITS.items()
    )


def _expanded(test: Test, which: slice, key: str = "targets_reached") -> tuple[Reading, ...]:
    """Makes two readings for the 1.5 m arena: zero-shot, and with arms that trained on it."""
    source = partial(measures.judged, key=key, stage=EXPANDED)
    return (
        Reading(name="zero-shot at 1.5 m", arms=PAIR[which], values=source, test=test),
        Reading(name="trained on at 1.5 m", arms=TUNED[which], values=source, test=test),
    )


_TARGETS = (_by_mean("targets_reached", LAST), _by_sampling(measures.targets, LAST))
_SENSED = (_by_mean("sensed_share", LAST), _by_sampling(measures.sensed_share, LAST))
_CONTACTS = (_by_mean("contacts_per_robot", LAST), _by_sampling(measures.contacts, LAST))
_CROWDING = ("last to arrive minus first", partial(measures.crowding, stage=LAST))
_MORE_SHARE = partial(higher, unit=SHARE)
_STEADY_IS = (
    f"Steady is the first episode from which {measures.WINDOW} episodes, and all to the end of the "
    f"run, have at least {measures.STEADY:g} of successes, and no later {measures.WINDOW} episodes "
    f"have less than {measures.KEPT:g}."
)
_DIFFERENCE = "The interval of the paired difference excludes 0, on the claim's side."

CLAIMS = (
    Claim(
        name="both",
        quote="both successfully generated the desired collective behavior",
        where="section 4",
        criterion=f"Share of targets reached on {LAST}: the intervals of curriculum and baseline "
        f"lie at or above {GENERATED:g}. Contradicted if one lies below.",
        figures="table of final policies, curves of the default trainer",
        readings=_readings(PAIR, partial(at_least, least=GENERATED), *_TARGETS),
    ),
    Claim(
        name="six_hundred",
        quote="approximately 600 episodes are required to achieve successful goal-reaching "
        "attempts",
        where="section 4, on Figure 6, PPO alone",
        criterion=f"{_STEADY_IS} The interval of the baseline lies within 300 to 900. Contradicted "
        "if it lies outside.",
        figures="figure 6",
        readings=_readings(("baseline",), partial(about, number=600.0), *_steady(None, "episode")),
    ),
    Claim(
        name="three_hundred",
        quote="the robot successfully attains the goal in approximately 300 episodes",
        where="section 4, on Figure 6, with curriculum",
        criterion=f"{_STEADY_IS} The interval of the curriculum lies within 150 to 450. "
        "Contradicted if it lies outside.",
        figures="figure 6",
        readings=_readings(
            ("curriculum",), partial(about, number=300.0), *_steady(None, "episode")
        ),
    ),
    Claim(
        name="faster_goal",
        quote="the robot exhibits faster learning towards reaching the goal",
        where="section 4, on Figure 6",
        criterion=f"{_STEADY_IS} The probability that a seed of the curriculum is steady before "
        "one of the baseline: the interval lies above 0.5. Contradicted if below.",
        figures="figure 6",
        readings=_readings(PAIR, earlier, *_steady(None, "episode"), *_steady(LAST, "steps")),
    ),
    Claim(
        name="faster_reward",
        quote="reached the optimal value faster than the traditional PPO approach",
        where="section 4, on Figure 7",
        criterion=f"First place at which the rolling mean of {measures.WINDOW} cumulative rewards "
        f"on {LAST} is 0.9 of the best one of any seed of either arm. The probability that a seed "
        "of the curriculum is there first: the interval lies above 0.5. Contradicted if below.",
        figures="figure 7",
        readings=_readings(PAIR, earlier, *_rewarded()),
    ),
    Claim(
        name="higher_success",
        quote="exhibited a higher success rate in reaching the targets",
        where="section 5",
        criterion=f"Share of targets reached on {LAST}, curriculum minus baseline. {_DIFFERENCE}",
        figures="table of final policies, curves of the default trainer",
        readings=_readings(PAIR, _MORE_SHARE, *_TARGETS),
    ),
    Claim(
        name="fewer_collisions",
        quote="demonstrates enhanced obstacle avoidance abilities",
        where="section 4, on Figure 8",
        criterion=f"On {LAST}, curriculum minus baseline: share of robot steps with something "
        f"within infrared range, and contacts per robot. {_DIFFERENCE}",
        figures="figure 8, table of final policies",
        readings=(
            *_readings(PAIR, partial(lower, unit=SHARE), *_called("infrared rule", _SENSED)),
            *_readings(PAIR, partial(lower, unit=NUMBER), *_called("contacts", _CONTACTS)),
        ),
    ),
    Claim(
        name="collisions_remain",
        quote="The collisions do not go to zero",
        where="section 4, on Figure 8",
        criterion=f"Share of robot steps with something within infrared range on {LAST}, "
        "curriculum: the interval lies above 0. Contradicted if it is 0.",
        figures="figure 8, table of final policies",
        readings=_readings(("curriculum",), above_zero, *_SENSED),
    ),
    Claim(
        name="aggregation",
        quote="because of the aggregation of the robots at the goal",
        where="section 4, on Figure 8",
        criterion="Control steps with something within infrared range, of the last robot to arrive "
        f"minus the first one, over the last {measures.WINDOW} episodes on {LAST}, curriculum. "
        "Contradicted if the interval does not exceed 0. Crowding would cause more of them, but "
        "the data do not show what a ray met, so they cannot reproduce the claim.",
        figures="figure 8",
        readings=_readings(("curriculum",), crowded, _CROWDING),
    ),
    Claim(
        name="expanded_better",
        quote="demonstrates more favorable outcomes",
        where="section 4, on the arena of 1.5 m",
        criterion=f"Share of targets reached on {EXPANDED}, curriculum minus baseline. "
        f"{_DIFFERENCE}",
        figures="figure 9",
        readings=_expanded(_MORE_SHARE, slice(None)),
    ),
    Claim(
        name="traditional_fails",
        quote="The robots trained using traditional PPO fail to reach the predefined goals",
        where="section 4, on Figure 9",
        criterion=f"Share of targets reached on {EXPANDED}, baseline: the interval lies below "
        f"{FAILED:g}. Contradicted if at or above.",
        figures="figure 9",
        readings=_expanded(partial(below, limit=FAILED), slice(1, 2)),
    ),
    Claim(
        name="expanded_converges",
        quote="the swarm's ability to converge and achieve the required collective behavior",
        where="section 4, on Figure 9, with curriculum",
        criterion=f"Share of targets reached on {EXPANDED}, curriculum: the interval lies at or "
        f"above {GENERATED:g}. Contradicted if below.",
        figures="figure 9",
        readings=_expanded(partial(at_least, least=GENERATED), slice(0, 1)),
    ),
    Claim(
        name="unseen",
        quote="the ability to transfer learned knowledge to previously unseen environments",
        where="section 5",
        criterion=f"Share of targets that the curriculum's policies reach on {EXPANDED}, on which "
        f"they were never trained: the interval lies at or above {GENERATED:g}. Contradicted if "
        "below.",
        figures="figure 9",
        readings=_expanded(partial(at_least, least=GENERATED), slice(0, 1))[:1],
    ),
)

GOALS = tuple(
    Reading(
        name=f"{arm}, at least {100 * least:.0f} % of the targets on {stage}",
        arms=(arm,),
        values=partial(measures.judged, key="targets_reached", stage=stage),
        test=partial(at_least, least=least),
    )
    for arm in MODERN
    for stage, least in ((LAST, 0.95), (EXPANDED, 0.90))
)
