"""A buffer of levels: which levels are played again, and which are replaced.

The curriculum's mode chooses the stage on which an episode begins. The buffer chooses the level of
that stage. Each stage has an equal part of the buffer, so no stage displaces another. The share of
arenas on a stage remains the stage's weight. The buffer stores the numbers that define a level.

- Prioritised level replay: Jiang et al. 2021, "Prioritized Level Replay", arXiv:2010.03934.
- Learnability: Rutherford et al. 2024, "No Regrets: Investigating and Improving Regret
  Approximations for Curriculum Discovery", arXiv:2408.15099.
- Mutation: Parker-Holder et al. 2022, "Evolving Curricula with Regret-Based Environment Design"
  (ACCEL), arXiv:2203.01302.

Axes: S stages, C levels of each in the buffer, V numbers of a level, N episodes.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax.curriculum.config import LevelsConfig

# Sources of an episode that begins on no level of the buffer: a level just drawn, a mutation of a
# level in the buffer, or a level that has since been replaced.
FRESH, MUTATED, LOST = -1, -2, -3

# Score of an empty place, below every real score.
_EMPTY = -1.0
# Episodes after which a level's older results fade, because the policy changes. The number is this
# project's choice.
_MEMORY = 16.0
# Weight of what is known before a level's first episode. This knowledge counts as much as two
# episodes with the mean success of the level's stage. The number is this project's choice.
_PRIOR_EPISODES = 2.0
_LARGEST_STEP = 0.25  # largest share of its range by which a mutation moves a number: our choice
_BELOW_ONE = np.float32(1.0 - 2.0**-24)  # the largest float32 below 1


class LevelNumbers(NamedTuple):
    """Numbers of the curriculum over levels, an argument of the compiled program.

    Attributes:
      replay: [] share of episodes that begin on a level of a full buffer.
      mutation: [] share of these replayed episodes that begin on a mutated level instead.
      temperature: [] temperature of the ranks; the higher, the more evenly levels are replayed.
      staleness: [] share of replays chosen by how long the levels have not been played.
      minimum_episodes: [] episodes that a level needs before it is mutated, int32.
      movable: [S, V] 1 for each number that a mutation may change, else 0; None without mutation.
    """

    replay: Array | np.float32
    mutation: Array | np.float32
    temperature: Array | np.float32
    staleness: Array | np.float32
    minimum_episodes: Array | np.int32
    movable: Array | np.ndarray | None = None


@struct.dataclass(kw_only=True)
class LevelBuffer:
    """The levels in the buffer, [S, C, ...].

    Attributes:
      numbers: [.., V] numbers that define the level, float32.
      episodes: ended episodes on the level, at most `_MEMORY`, float32; 0: the place is empty.
      successes: successes among these episodes, float32.
      loss: positive value loss of the newest episodes, float32.
      score: the higher, the sooner the level is played again, float32.
      begun: update in which an episode last began on it, int32.
      generation: number of mutations since the drawn level, int32.
      clock: [] updates so far, int32.
    """

    numbers: Array
    episodes: Array
    successes: Array
    loss: Array
    score: Array
    begun: Array
    generation: Array
    clock: Array

    @property
    def held(self) -> Array:
        """Whether there is a level in the place, [S, C]."""
        return self.episodes > 0.0


class Play(NamedTuple):
    """Episodes of an update, [N].

    Attributes:
      slot: place of the episode's level in the buffer, counted through all stages; or `FRESH`,
        `MUTATED` or `LOST`.
      stage: stage of the level.
      begun: whether the episode began in this update.
      ended: whether the episode ended in this update.
      successes: number of successful trials, int32; 0 unless the episode ended.
      trials: number of robots, or 1 if the episode counts as a whole, int32.
      loss: positive value loss, mean over the transitions of all robots.
      numbers: [.., V] numbers that define the level.
      generation: generation of the level.
    """

    slot: Array
    stage: Array
    begun: Array
    ended: Array
    successes: Array
    trials: Array
    loss: Array
    numbers: Array
    generation: Array


def init(stages: int, size: int, numbers: int) -> LevelBuffer:
    """Makes an empty buffer.

    Args:
      stages: S.
      size: places of all stages together, at least S; C is size / S, rounded down.
      numbers: V.

    Returns:
      An empty buffer.
    """
    shape = (stages, size // stages)
    zero, none = jnp.zeros(shape, jnp.float32), jnp.zeros(shape, jnp.int32)
    return LevelBuffer(
        numbers=jnp.zeros((*shape, numbers), jnp.float32),
        episodes=zero,
        successes=zero,
        loss=zero,
        score=jnp.full(shape, _EMPTY, jnp.float32),
        begun=none,
        generation=none,
        clock=jnp.zeros((), jnp.int32),
    )


def probabilities(buffer: LevelBuffer, options: LevelNumbers) -> Array:
    """Computes how probable each level is, given that a level of the same stage is replayed.

    The probability is (1 - rho) P_score + rho P_stale. P_score is proportional to rank^(-1 /
    temperature). P_stale is proportional to the number of updates since an episode last began on
    the level (Jiang et al. 2021, equations 2 to 5).

    Args:
      buffer: buffer of levels.
      options: `temperature` and `staleness` (rho).

    Returns:
      [S, C], 0 where there is no level; the sum is 1 for each stage with a level.
    """
    order = jnp.argsort(-buffer.score, axis=1, stable=True)
    rank = jnp.argsort(order, axis=1, stable=True) + 1
    weight = jnp.exp(-jnp.log(rank.astype(jnp.float32)) / options.temperature)
    by_score = _normal(jnp.where(buffer.held, weight, 0.0))
    age = jnp.where(buffer.held, buffer.clock - buffer.begun, 0).astype(jnp.float32)
    by_age = jnp.where(jnp.any(age > 0.0, axis=1, keepdims=True), _normal(age), by_score)
    return (1.0 - options.staleness) * by_score + options.staleness * by_age


def _normal(weight: Array) -> Array:
    """Divides weights [S, C] by their sum on each stage, unless that sum is 0."""
    total = jnp.sum(weight, axis=1, keepdims=True)
    return weight / jnp.where(total > 0.0, total, 1.0)


def choose(buffer: LevelBuffer, options: LevelNumbers, stage: Array, picks: Array) -> Array:
    """Chooses the level on which each episode begins.

    The replayed share grows with the filled part of the stage's places, so that the first levels
    are not played over and over.

    Args:
      buffer: buffer of levels.
      options: the curriculum's numbers.
      stage: [N] stage of the episodes.
      picks: [N, 2] uniform numbers in [0, 1).

    Returns:
      [N] place in the buffer, counted through all stages; `FRESH` for a level still to be drawn.
    """
    stages, places = buffer.score.shape
    held = buffer.held
    share = options.replay * jnp.mean(held.astype(jnp.float32), axis=1)
    ends = jnp.cumsum(probabilities(buffer, options), axis=1)
    ends = ends / jnp.maximum(ends[:, -1:], np.finfo(np.float32).tiny)
    # Puts the cumulative shares of all stages on one line, so that one search suffices. The shares
    # of a stage are shifted by the stage's index.
    line = (ends + jnp.arange(stages)[:, None]).ravel()
    found = jnp.searchsorted(line, stage + picks[:, 1], side="right")
    # Rounding may lead past a stage's last level, or to the end of the stage before.
    last = jnp.max(jnp.where(held, jnp.arange(places), 0), axis=1)
    found = jnp.clip(found, stage * places, stage * places + last[stage])
    return jnp.where(picks[:, 0] < share[stage], found, FRESH).astype(jnp.int32)


def update(
    buffer: LevelBuffer, plays: Play, config: LevelsConfig, usual: Array
) -> tuple[LevelBuffer, Array]:
    """Adds an update's episodes: scores all levels again, and lets the best new ones in.

    Args:
      buffer: before.
      plays: [N] episodes of all arenas, on all devices.
      config: defines the score.
      usual: [S] mean success of the episodes of each stage, 0 to 1.

    Returns:
      The buffer after, and [S C] whether the level in each place is new.
    """
    buffer = _score(_record(buffer, plays), config, usual)
    buffer, taken = _admit(buffer, plays, config, usual)
    return replace(buffer, clock=buffer.clock + 1), taken


def mark_lost(slot: Array, taken: Array) -> Array:
    """Marks as lost the slots [...] of episodes whose level has been replaced."""
    gone = (slot >= 0) & taken[jnp.maximum(slot, 0)]
    return jnp.where(gone, LOST, slot)


def _record(buffer: LevelBuffer, plays: Play) -> LevelBuffer:
    """Adds the outcomes of episodes on levels of the buffer."""
    count = buffer.score.size

    def total(value: Array, mine: Array) -> Array:
        at = jnp.where(mine & (plays.slot >= 0), plays.slot, count)
        blank = jnp.zeros(count, value.dtype)
        return blank.at[at].add(value, mode="drop").reshape(buffer.score.shape)

    one = jnp.ones_like(plays.slot)
    new, begun = total(one, plays.ended), total(one, plays.begun)
    # Adds up whole numbers before any division, because their sum is the same in any order.
    successes, trials = (total(x, plays.ended) for x in (plays.successes, plays.trials))
    episodes = buffer.episodes + new
    successes = buffer.successes + new * (successes / jnp.maximum(trials, 1))
    kept = jnp.minimum(1.0, _MEMORY / jnp.maximum(episodes, 1.0))
    loss = total(plays.loss, plays.ended) / jnp.maximum(new, 1)
    return replace(
        buffer,
        episodes=kept * episodes,
        successes=kept * successes,
        loss=jnp.where(new > 0, loss, buffer.loss),
        begun=jnp.where(begun > 0, buffer.clock, buffer.begun),
    )


def _score(buffer: LevelBuffer, config: LevelsConfig, usual: Array) -> LevelBuffer:
    """Scores all levels again."""
    found = _SCORES[_mode(config)](
        buffer.episodes, buffer.successes, buffer.loss, jnp.asarray(usual)[:, None]
    )
    return replace(buffer, score=jnp.where(buffer.held, found, _EMPTY))


def _mode(config: LevelsConfig) -> str:
    assert config.mode in _SCORES, config.mode  # other modes have no buffer
    return config.mode


def _posterior(episodes: Array, successes: Array, usual: Array) -> tuple[Array, Array]:
    """Returns the parameters of the beta distribution of a level's success p."""
    a = successes + _PRIOR_EPISODES * usual
    return a, episodes - successes + _PRIOR_EPISODES * (1.0 - usual)


def _learnability(episodes: Array, successes: Array, loss: Array, usual: Array) -> Array:
    """Returns the expected p (1 - p) of a level, given its episodes alone.

    If p has a beta distribution with parameters a and b, this is a b / ((a + b) (a + b + 1)). The
    result grows with the number of episodes: one episode is too little evidence to displace a level
    with p near 1/2.
    """
    a, b = _posterior(episodes, successes, usual)
    return a * b / ((a + b) * (a + b + 1.0))


def _failure(episodes: Array, successes: Array, loss: Array, usual: Array) -> Array:
    """Returns the expected 1 - p of a level: b / (a + b) for a beta distribution."""
    a, b = _posterior(episodes, successes, usual)
    return b / (a + b)


def _value_loss(episodes: Array, successes: Array, loss: Array, usual: Array) -> Array:
    """Returns the newest positive value loss (Jiang et al. 2021, "Replay-Guided ...", eq. 3)."""
    return jnp.broadcast_to(loss, episodes.shape)


_SCORES: dict[str, Callable[[Array, Array, Array, Array], Array]] = {
    "learnability": _learnability,
    "failure": _failure,
    "value_loss": _value_loss,
}


def _admit(
    buffer: LevelBuffer, plays: Play, config: LevelsConfig, usual: Array
) -> tuple[LevelBuffer, Array]:
    """Replaces the worst levels with the best new ones, if these have a higher score."""
    stages, places = buffer.score.shape
    new = plays.ended & ((plays.slot == FRESH) | (plays.slot == MUTATED))
    share = plays.successes / jnp.maximum(plays.trials, 1)
    one = jnp.ones_like(share)
    score = _SCORES[_mode(config)](one, share, plays.loss, jnp.asarray(usual)[plays.stage])
    stage = jnp.where(new, plays.stage, stages)
    order = jnp.lexsort((-score, stage))
    first = jnp.searchsorted(stage[order], jnp.arange(stages + 1))
    sorted_stage = stage[order]
    rank = jnp.arange(len(order)) - first[sorted_stage]
    worst = jnp.argsort(buffer.score, axis=1, stable=True)
    at = jnp.minimum(sorted_stage, stages - 1)
    place = worst[at, jnp.minimum(rank, places - 1)]
    enters = (sorted_stage < stages) & (rank < places) & (score[order] > buffer.score[at, place])
    slot = jnp.where(enters, at * places + place, stages * places)
    taken = jnp.zeros(stages * places, bool).at[slot].set(True, mode="drop")
    entries = {
        "numbers": plays.numbers,
        "episodes": one,
        "successes": share,
        "loss": plays.loss,
        "score": score,
        "begun": jnp.broadcast_to(buffer.clock, plays.slot.shape),
        "generation": plays.generation,
    }

    def put(name: str, values: Array) -> Array:
        old = getattr(buffer, name)
        flat = old.reshape(stages * places, *old.shape[2:])
        return flat.at[slot].set(values[order], mode="drop").reshape(old.shape)

    return replace(buffer, **{name: put(name, each) for name, each in entries.items()}), taken


def describe(buffer: LevelBuffer, plays: Play) -> dict[str, Any]:
    """Summarises the practised levels by stage.

    Args:
      buffer: after `update`.
      plays: [N] episodes of the update.

    Returns:
      [S] each: `levels_fresh`, `levels_replayed` and `levels_mutated` count the ended episodes by
      their source, and `levels_held` the levels in the buffer. `levels_success`, `levels_score` and
      `levels_generation` are the means over those levels, nan if there are none.
    """
    stages, held = buffer.score.shape[0], buffer.held
    mine = plays.stage == jnp.arange(stages)[:, None]
    kinds = {
        "fresh": plays.slot == FRESH,
        "replayed": (plays.slot >= 0) | (plays.slot == LOST),
        "mutated": plays.slot == MUTATED,
    }
    ended = {
        f"levels_{kind}": jnp.sum(mine & plays.ended & found, axis=1, dtype=jnp.int32)
        for kind, found in kinds.items()
    }

    def mean(values: Array) -> Array:
        return jnp.mean(values.astype(jnp.float32), axis=1, where=held)

    return ended | {
        "levels_held": jnp.sum(held, axis=1, dtype=jnp.int32),
        "levels_success": mean(buffer.successes / jnp.maximum(buffer.episodes, 1.0)),
        "levels_score": mean(buffer.score),
        "levels_generation": mean(buffer.generation),
    }


def mutate(numbers: Array, movable: Array, picks: Array) -> Array:
    """Changes one thing in a level: moves one number by at most a quarter of that number's range.

    Args:
      numbers: [V] numbers that define the level.
      movable: [V] 1 for each number that may change, else 0.
      picks: [2] uniform numbers in [0, 1).

    Returns:
      [V] numbers in [0, 1) of the mutated level. The mutated level is drawn by the same rules as
      any other level.
    """
    ends = jnp.cumsum(movable)
    chosen = jnp.searchsorted(ends, picks[0] * ends[-1], side="right")
    moved = numbers + (picks[1] - 0.5) * np.float32(2.0 * _LARGEST_STEP)
    inside = jnp.where(moved < 0.0, -moved, jnp.where(moved >= 1.0, 2.0 - moved, moved))
    inside = jnp.minimum(inside, _BELOW_ONE)
    return jnp.where(jnp.arange(numbers.shape[0]) == chosen, inside, numbers)


def split_picks(key: Array, shape: tuple[int, ...]) -> Array:
    """Draws uniform numbers [*shape, 5]: for `choose`, for whether to mutate, and for `mutate`."""
    return jax.random.uniform(key, (*shape, 5))
