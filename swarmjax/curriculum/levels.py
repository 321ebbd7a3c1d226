"""Replays levels of a curriculum over stages: those that teach most are played again.

The curriculum over stages chooses the stage on which an episode begins, and the buffer chooses the
level of that stage. Each stage has an equal part of the buffer, so no stage displaces another. The
share of arenas on a stage remains the stage's weight. The buffer stores the seeds of levels.

- Prioritised level replay: Jiang et al. 2021, "Prioritized Level Replay", arXiv:2010.03934.
- Learnability: Rutherford et al. 2024, "No Regrets: Investigating and Improving Regret
  Approximations for Curriculum Discovery", arXiv:2408.15099.

Axes: S stages, C levels of each in the buffer, E episodes.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import UNCOUNTED, Curriculum, CurriculumOutcomes, Next, StageChoice
from swarmjax.task.episode import Ended

_EMPTY = -1.0  # score of an empty place, below every real score
# The numbers below are this project's choice. With thousands of arenas, the papers' temperatures
# (0.1 to 0.3) would put most of the arenas on a single level.
_PLACES = 4096  # levels of the buffer, an equal number for each stage
_REPLAY = 0.5  # share of episodes that begin on a level of a full buffer
_TEMPERATURE = 2.0  # replay is proportional to rank^(-1 / temperature)
_STALENESS = 0.1  # share of the replay that depends on the time since a level was last played
_MEMORY = 16.0  # episodes after which a level's older results fade, because the policy changes
# What is known before a level's first episode counts as much as this number of episodes with the
# mean success of the level's stage.
_PRIOR_EPISODES = 2.0


@struct.dataclass(kw_only=True)
class LevelBuffer:
    """The levels in the buffer, [S, C].

    Attributes:
      seed: seed of the level, uint32.
      episodes: ended episodes on the level, at most `_MEMORY`, float32; 0: the place is empty.
      successes: successes among these episodes, float32.
      score: the higher, the sooner the level is played again, float32.
      played: update in which an episode last ended on it, int32.
    """

    seed: Array
    episodes: Array
    successes: Array
    score: Array
    played: Array

    @property
    def held(self) -> Array:
        """Whether there is a level in the place, [S, C]."""
        return self.episodes > 0.0


@struct.dataclass(kw_only=True)
class ReplayState:
    """The state of a curriculum that replays levels.

    Attributes:
      inner: state of the curriculum over stages.
      buffer: the levels.
      update: [] number of finished updates, int32.
    """

    inner: Any
    buffer: LevelBuffer
    update: Array

    @property
    def chosen(self) -> StageChoice:
        """What is trained now."""
        return self.inner.chosen


class Plays(NamedTuple):
    """Ended episodes of an update, [E].

    Attributes:
      over: whether the row holds an episode.
      stage: stage of the level, int32.
      seed: seed of the level, uint32.
      fresh: whether the level was new when the episode began.
      successes: number of successful trials, int32.
      trials: number of robots, or 1 if the episode counts as a whole, int32.
      loss: value loss of the episode.
    """

    over: Array
    stage: Array
    seed: Array
    fresh: Array
    successes: Array
    trials: Array
    loss: Array


def make(inner: Curriculum, stages: int, options: CurriculumConfig) -> Curriculum:
    """Adds a buffer of levels to a curriculum over `stages` stages.

    Half of the levels that it chooses are new, once the buffer is full.
    """

    def init() -> ReplayState:
        buffer = empty(stages, max(1, _PLACES // stages))
        return ReplayState(inner=inner.init(), buffer=buffer, update=jnp.zeros((), jnp.int32))

    def choose(state: ReplayState, key: Array, free: tuple[int, int]) -> Next:
        seed_key, pick_key, inner_key = jax.random.split(key, 3)
        stage = inner.choose(state.inner, inner_key, free).stage
        shares = probabilities(state.buffer, state.update)
        picks = jax.random.uniform(pick_key, (stage.size, 2))
        place = pick(state.buffer, shares, stage.ravel(), picks).reshape(free)
        again = place >= 0
        old = state.buffer.seed.ravel()[jnp.maximum(place, 0)]
        new = jax.random.bits(seed_key, free, jnp.uint32)
        return Next(stage, jnp.where(again, old, new), again)

    def observe(state: ReplayState, outcomes: CurriculumOutcomes) -> ReplayState:
        plays = list_plays(outcomes.ended, outcomes.value_loss, options)
        fast = outcomes.verdict.record.fast
        usual = jnp.where(jnp.isfinite(fast), fast, 0.5)
        return ReplayState(
            inner=inner.observe(state.inner, outcomes),
            buffer=update(state.buffer, plays, options.levels, usual, state.update),
            update=state.update + 1,
        )

    return Curriculum(init, choose, observe)


def empty(stages: int, places: int) -> LevelBuffer:
    """Makes an empty buffer with `places` for each stage."""
    zero = jnp.zeros((stages, places), jnp.float32)
    return LevelBuffer(
        seed=zero.astype(jnp.uint32),
        episodes=zero,
        successes=zero,
        score=zero + _EMPTY,
        played=zero.astype(jnp.int32),
    )


def probabilities(buffer: LevelBuffer, now: Array) -> Array:
    """Computes how probable each level is, given that a level of the same stage is replayed.

    The probability is (1 - rho) P_score + rho P_stale. P_score is proportional to rank^(-1 /
    temperature). P_stale is proportional to the number of updates since an episode last ended on
    the level. rho is the staleness (Jiang et al. 2021, equations 2 to 5).

    Args:
      buffer: buffer of levels.
      now: [] number of finished updates.

    Returns:
      [S, C], 0 where there is no level; the sum is 1 for each stage with a level.
    """
    order = jnp.argsort(-buffer.score, axis=1, stable=True)
    rank = jnp.argsort(order, axis=1, stable=True) + 1
    weight = jnp.exp(-jnp.log(rank.astype(jnp.float32)) / _TEMPERATURE)
    by_score = _normal(jnp.where(buffer.held, weight, 0.0))
    age = jnp.where(buffer.held, now - buffer.played, 0).astype(jnp.float32)
    by_age = jnp.where(jnp.any(age > 0.0, axis=1, keepdims=True), _normal(age), by_score)
    return (1.0 - _STALENESS) * by_score + _STALENESS * by_age


def _normal(weight: Array) -> Array:
    """Divides weights [S, C] by their sum on each stage, unless that sum is 0."""
    total = jnp.sum(weight, axis=1, keepdims=True)
    return weight / jnp.where(total > 0.0, total, 1.0)


def pick(buffer: LevelBuffer, shares: Array, stage: Array, picks: Array) -> Array:
    """Picks the level on which each episode begins.

    The replayed share grows with the filled part of the stage's places, so that the first levels
    are not played over and over.

    Args:
      buffer: buffer of levels.
      shares: [S, C] from `probabilities`.
      stage: [E] stage of the episodes.
      picks: [E, 2] uniform numbers in [0, 1).

    Returns:
      [E] place in the buffer, counted through all stages; -1 for a new level.
    """
    stages, places = shares.shape
    held = buffer.held
    share = _REPLAY * jnp.mean(held.astype(jnp.float32), axis=1)
    ends = jnp.cumsum(shares, axis=1)
    ends = ends / jnp.maximum(ends[:, -1:], np.finfo(np.float32).tiny)
    # Puts the cumulative shares of all stages on one line, so that one search suffices. The shares
    # of a stage are shifted by the stage's index.
    line = (ends + jnp.arange(stages)[:, None]).ravel()
    place = jnp.searchsorted(line, stage + picks[:, 1], side="right")
    # Rounding may lead past a stage's last level, or to the end of the stage before.
    last = jnp.max(jnp.where(held, jnp.arange(places), 0), axis=1)
    place = jnp.clip(place, stage * places, stage * places + last[stage])
    return jnp.where(picks[:, 0] < share[stage], place, -1).astype(jnp.int32)


def list_plays(ended: Ended, loss: Array, options: CurriculumConfig) -> Plays:
    """Lists the episodes that ended in an update.

    Args:
      ended: [T, A], with the levels' seeds.
      loss: [T, A] value loss of the episodes.
      options: define success.

    Returns:
      [E], with room for an episode of every arena in eight control steps: shorter ones are rare.
    """
    assert ended.level is not None
    steps, arenas = loss.shape
    over = ended.episodes.ravel() > 0
    at = jnp.nonzero(over, size=max(arenas, steps * arenas // 8), fill_value=0)[0]
    whole = options.success == "all"
    return Plays(
        over=jnp.arange(at.size) < jnp.sum(over),
        stage=ended.stage.ravel()[at],
        seed=ended.level.ravel()[at],
        fresh=ended.cohort.ravel()[at] != UNCOUNTED,
        successes=(ended.all_reached if whole else ended.reached).ravel()[at],
        trials=(ended.episodes if whole else ended.targets).ravel()[at],
        loss=loss.ravel()[at],
    )


def update(buffer: LevelBuffer, plays: Plays, mode: str, usual: Array, now: Array) -> LevelBuffer:
    """Adds an update's episodes: scores all levels again, and lets the best new ones in.

    Args:
      buffer: before.
      plays: [E] ended episodes of all arenas.
      mode: `learnability` or `value_loss`.
      usual: [S] mean success of the episodes of each stage, 0 to 1.
      now: [] number of finished updates.

    Returns:
      The buffer after.
    """
    # Adds up whole numbers before any division, because their sum is the same in any order.
    one = jnp.ones_like(plays.stage)
    values = [one, plays.successes, plays.trials, plays.loss]
    new, successes, trials, loss = _sums(buffer, plays, values)
    episodes = buffer.episodes + new
    successes = buffer.successes + new * (successes / jnp.maximum(trials, 1))
    kept = jnp.minimum(1.0, _MEMORY / jnp.maximum(episodes, 1.0))
    episodes, successes = kept * episodes, kept * successes
    if mode == "learnability":
        score = learnability(episodes, successes, usual[:, None])
        score = jnp.where(episodes > 0.0, score, _EMPTY)
    else:  # the newest positive value loss (Jiang et al. 2021, "Replay-Guided ...", equation 3)
        score = jnp.where(new > 0, loss / jnp.maximum(new, 1), buffer.score)
    played = jnp.where(new > 0, now, buffer.played)
    scored = LevelBuffer(
        seed=buffer.seed, episodes=episodes, successes=successes, score=score, played=played
    )
    return _admit(scored, plays, mode, usual, now)


def learnability(episodes: Array, successes: Array, usual: Array) -> Array:
    """Returns the expected p (1 - p) of a level with success p, given its episodes alone.

    If p has a beta distribution with parameters a and b, this is a b / ((a + b) (a + b + 1)). The
    result grows with the number of episodes: one episode is too little evidence to displace a level
    with p near 1/2.
    """
    a = successes + _PRIOR_EPISODES * usual
    b = episodes - successes + _PRIOR_EPISODES * (1.0 - usual)
    return a * b / ((a + b) * (a + b + 1.0))


def _sums(buffer: LevelBuffer, plays: Plays, values: list[Array]) -> list[Array]:
    """Adds up values [E] of the episodes on each level of the buffer, [S, C] each."""
    seeds = buffer.seed.ravel()
    order = jnp.argsort(seeds)
    near = jnp.minimum(jnp.searchsorted(seeds[order], plays.seed), seeds.size - 1)
    place = order[near]
    known = plays.over & (seeds[place] == plays.seed) & buffer.held.ravel()[place]
    at = jnp.where(known, place, seeds.size)

    def total(value: Array) -> Array:
        blank = jnp.zeros(seeds.size, value.dtype)
        return blank.at[at].add(value, mode="drop").reshape(buffer.seed.shape)

    return [total(value) for value in values]


def _admit(buffer: LevelBuffer, plays: Plays, mode: str, usual: Array, now: Array) -> LevelBuffer:
    """Replaces the worst levels with the best new ones, if these have a higher score."""
    stages, places = buffer.score.shape
    share = plays.successes / jnp.maximum(plays.trials, 1)
    one = jnp.ones_like(share)
    score = plays.loss
    if mode == "learnability":
        score = learnability(one, share, usual[plays.stage])
    stage = jnp.where(plays.over & plays.fresh, plays.stage, stages)
    order = jnp.lexsort((-score, stage))
    first = jnp.searchsorted(stage[order], jnp.arange(stages + 1))
    sorted_stage = stage[order]
    rank = jnp.arange(len(order)) - first[sorted_stage]
    worst = jnp.argsort(buffer.score, axis=1, stable=True)
    at = jnp.minimum(sorted_stage, stages - 1)
    place = worst[at, jnp.minimum(rank, places - 1)]
    enters = (sorted_stage < stages) & (rank < places) & (score[order] > buffer.score[at, place])
    slot = jnp.where(enters, at * places + place, stages * places)
    entries = {"seed": plays.seed, "episodes": one, "successes": share, "score": score}

    def put(name: str, values: Array) -> Array:
        flat = getattr(buffer, name).ravel().at[slot].set(values[order], mode="drop")
        return flat.reshape(stages, places)

    entries["played"] = jnp.full_like(plays.stage, now)
    return replace(buffer, **{name: put(name, values) for name, values in entries.items()})
