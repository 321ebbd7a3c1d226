"""Decides the claims in the paper's text with the data of a reproduction. Needs no JAX.

The criteria that support or contradict a claim were fixed before any data existed;
`templates/claims.yaml` states them. A claim has one reading for each way to understand the paper
(docs/paper.md). The first reading is the primary reading, which was named before the data of fifty
seeds existed. The primary reading alone decides; the report also shows the other readings. Every
number is an interquartile mean over seeds with its 95 % bootstrap interval. A claim is reproduced
if its primary reading holds, and not reproduced if the data contradict the primary reading. The
claim is undecidable if the interval straddles the limit or an arm is missing. A reproduction with
less than the paper's budget gives no verdicts.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from swarmjax.config.reading import parse_yaml
from swarmjax.pages import builder
from swarmjax.reproduce import measures
from swarmjax.reproduce.criteria import Criterion, about, crowded, earlier, higher, opposite, within
from swarmjax.reproduce.measures import NUMBER, SHARE, Axis, Measure
from swarmjax.reproduce.rows import EXPANDED, LAST, PAIR, TUNED, Reproduction

# Share of targets reached that counts as the desired behaviour, and that promotes to the next
# stage.
GENERATED = 0.8
FAILED = 0.5  # a swarm fails if it reaches a smaller share of its targets
HELD = {True: "holds", False: "contradicted", None: "open"}

# A function of `measures` with its options set. It returns a value for each seed of an arm, [N].
type Values = Callable[[Reproduction, str], np.ndarray]
type Source = tuple[str, Values]  # the name of such a function in words, and the function


class Reading(NamedTuple):
    """One way to understand a claim.

    Attributes:
      name: name in words.
      arms: finished arms that the reading needs.
      values: returns the values of an arm, [N].
      test: tests the claim with the values of all arms, in the order of `arms`.
    """

    name: str
    arms: tuple[str, ...]
    values: Values
    test: Criterion


class Finding(NamedTuple):
    """The result of a reading of a claim.

    Attributes:
      reading: name of the reading.
      holds: whether the claim holds in this reading; None if undecided.
      text: the numbers behind the result.
    """

    reading: str
    holds: bool | None
    text: str


class Claim(NamedTuple):
    """A claim in the paper's text.

    Attributes:
      name: key of the claim in `claims.yaml`.
      quote: the paper's sentence, word for word.
      where: the section of the paper that makes the claim.
      criterion: what supports the claim, and what contradicts the claim.
      figures: figures and tables of the report that show whether the claim holds.
      readings: the readings; the first one, the primary reading, decides.
    """

    name: str
    quote: str
    where: str
    criterion: str
    figures: str
    readings: tuple[Reading, ...]


class ClaimVerdict(NamedTuple):
    """The verdict on a claim: the outcome, the reason if it is open, and the readings' findings."""

    claim: Claim
    outcome: Literal["reproduced", "not reproduced", "undecidable", "no verdict"]
    reason: str
    findings: tuple[Finding, ...]


def verdict(data: Reproduction, claim: Claim) -> ClaimVerdict:
    """Decides a claim by its primary reading, unless the runs were too short."""
    findings = tuple(evaluate(data, reading) for reading in claim.readings)
    if data.settings.is_short:
        undecided = tuple(each._replace(holds=None) for each in findings)
        return ClaimVerdict(claim, "no verdict", "too short", undecided)
    holds = findings[0].holds
    if holds is not None:
        return ClaimVerdict(claim, "reproduced" if holds else "not reproduced", "", findings)
    missing = data.lacking(claim.readings[0].arms)
    reason = "an arm is missing" if missing else "its primary reading is open"
    return ClaimVerdict(claim, "undecidable", reason, findings)


def evaluate(data: Reproduction, reading: Reading) -> Finding:
    """Evaluates a reading, which stays open if an arm is missing or a seed has too few episodes."""
    lacking = data.lacking(reading.arms)
    if lacking:
        return Finding(reading.name, None, f"lacks {' and '.join(lacking)}")
    values = [reading.values(data, arm) for arm in reading.arms]
    if np.isnan(values).any():
        return Finding(reading.name, None, "a seed has too few episodes for it")
    return Finding(reading.name, *reading.test(*values))


def _final_and_late(key: str, of: Measure) -> list[Source]:
    """Lists sources of values on the last stage: the final policies, and the end of training.

    The final policies with sampled actions come first, those with mean actions second.
    """
    late = f"last {measures.WINDOW} episodes of training on {LAST}, sampled actions"
    final = partial(measures.judged, key=key, stage=LAST)
    return [
        ("final policies, sampled actions", final),
        ("final policies, mean action", partial(final, action="mean")),
        (late, partial(measures.late, of=of, stage=LAST)),
    ]


def _named(what: str, sources: Iterable[Source]) -> list[Source]:
    """Puts the name of the quantity in front of each source's name."""
    return [(f"{what}, {name}", values) for name, values in sources]


def _readings(
    arms: tuple[str, ...], test: Criterion, sources: Iterable[Source]
) -> tuple[Reading, ...]:
    """Makes one reading per source of values, all with the same arms and the same test."""
    return tuple(Reading(name, arms, values, test) for name, values in sources)


def steady(stage: str | None, axis: Axis) -> list[tuple[str, str, Values]]:
    """Lists the ways to find when success becomes steady, one per definition of success.

    Args:
      stage: uses only the episodes of this stage; None for all.
      axis: whether to count training in episodes or in arena control steps.

    Returns:
      For each reading: the goal, what is counted, and a function that finds where each seed of an
      arm reaches the goal.
    """
    which = "all episodes" if stage is None else f"episodes on {stage}"
    counted = f"{which}, {measures.UNITS[axis]}"
    return [
        (goal, counted, partial(measures.steady_at, success=success, axis=axis, stage=stage))
        for goal, success in measures.SUCCESS.items()
    ]


def _steady(stage: str | None, axis: Axis) -> list[Source]:
    return [(f"{goal}, {counted}", values) for goal, counted, values in steady(stage, axis)]


def _rewarded() -> list[Source]:
    """Lists the ways to find where the reward on the last stage nears its best value.

    There are four: by the reward of robot 1 or by the mean reward, counted in episodes or in arena
    control steps.
    """
    kinds = {"robot 1": measures.first_reward, "mean of the robots": measures.mean_reward}
    return [
        (
            f"{name}, {unit}",
            partial(measures.reward_reached, of=of, axis=axis, rivals=PAIR, stage=LAST),
        )
        for name, of in kinds.items()
        for axis, unit in measures.UNITS.items()
    ]


def _expanded(test: Criterion, which: slice) -> tuple[Reading, ...]:
    """Makes the readings for the 1.5 m arena.

    The arms that continued their training in this arena come first, because Figure 9 shows
    episodes, and the paper's word "converge" is about training. The arms that never trained there
    (zero-shot) come second.
    """
    values = partial(measures.judged, key="targets_reached", stage=EXPANDED)
    by_mean = partial(values, action="mean")
    return (
        Reading("trained on at 1.5 m, sampled actions", TUNED[which], values, test),
        Reading("trained on at 1.5 m, mean action", TUNED[which], by_mean, test),
        Reading("zero-shot at 1.5 m, sampled actions", PAIR[which], values, test),
        Reading("zero-shot at 1.5 m, mean action", PAIR[which], by_mean, test),
    )


_OURS, _THEIRS = PAIR[:1], PAIR[1:]
_TARGETS = _final_and_late("targets_reached", measures.targets)
_SENSED = _final_and_late("sensed_share", measures.sensed_share)
_CONTACTS = _final_and_late("contacts_per_robot", measures.contacts)
_CROWDING = ("last to arrive minus first", partial(measures.crowding, stage=LAST))
_GENERATED = partial(within, low=GENERATED)
_MORE_SHARE = partial(higher, unit=SHARE)
_ALONE = _expanded(_GENERATED, slice(0, 1))
_READINGS = {
    "both": _readings(PAIR, _GENERATED, _TARGETS),
    "six_hundred": _readings(_THEIRS, about(600), _steady(None, "episode")),
    "three_hundred": _readings(_OURS, about(300), _steady(None, "episode")),
    "faster_goal": _readings(PAIR, earlier, _steady(None, "episode") + _steady(LAST, "steps")),
    "faster_reward": _readings(PAIR, earlier, _rewarded()),
    "higher_success": _readings(PAIR, _MORE_SHARE, _TARGETS),
    "fewer_collisions": (
        *_readings(PAIR, opposite(_MORE_SHARE), _named("infrared rule", _SENSED)),
        *_readings(PAIR, opposite(partial(higher, unit=NUMBER)), _named("contacts", _CONTACTS)),
    ),
    "collisions_remain": _readings(_OURS, opposite(partial(within, low=0.0, high=0.0)), _SENSED),
    "aggregation": _readings(_OURS, crowded, [_CROWDING]),
    "expanded_better": _expanded(_MORE_SHARE, slice(None)),
    "traditional_fails": _expanded(opposite(partial(within, low=FAILED)), slice(1, 2)),
    "expanded_converges": _ALONE,
    "unseen": _ALONE[2:],
}
_WORDS = {
    "last": LAST,
    "expanded": EXPANDED,
    "window": measures.WINDOW,
    "generated": GENERATED,
    "failed": FAILED,
    "difference": "The interval of the paired difference excludes 0, on the claim's side.",
    "steady": f"Steady is the first episode from which {measures.WINDOW} episodes, and all to the "
    f"end of the run, have at least {measures.STEADY:g} of successes, and no later "
    f"{measures.WINDOW} episodes have less than {measures.KEPT:g}.",
}


def _read_claims() -> tuple[Claim, ...]:
    """Reads the claims, and fills in the numbers of their criteria."""
    claims = parse_yaml(builder.read("reproduce/claims.yaml"), "claims.yaml: ")
    return tuple(
        Claim(
            name=name,
            readings=_READINGS[name],
            **{key: text.format_map(_WORDS) for key, text in texts.items()},
        )
        for name, texts in claims.items()
    )


CLAIMS = _read_claims()
