"""Checks the replay of levels against NumPy: scores, choices, and which levels are kept."""

from dataclasses import replace
from typing import Any

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from swarmjax.curriculum import levels
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import UNCOUNTED
from swarmjax.curriculum.levels import LevelBuffer, Plays
from swarmjax.task.episode import Ended

LEARNABILITY, VALUE_LOSS = "learnability", "value_loss"
HALF = np.full(2, 0.5, np.float32)  # usual success of two stages
UPDATE, PICK = jax.jit(levels.update, static_argnums=2), jax.jit(levels.pick)


def _plays(seed: Any, stage: Any, **given: Any) -> Plays:
    """Returns ended episodes with one trial each; a seed below 100 is that of a fresh level."""
    count, seed = len(seed), np.asarray(seed, np.uint32)
    columns = {
        "over": np.ones(count, bool),
        "fresh": seed < 100,
        "successes": np.zeros(count, np.int32),
        "trials": np.ones(count, np.int32),
        "loss": np.zeros(count, np.float32),
        **given,
    }
    values = {key: jnp.asarray(value) for key, value in columns.items()}
    return Plays(stage=jnp.asarray(stage, jnp.int32), seed=jnp.asarray(seed), **values)


def _again(seed: Any, stage: Any, **given: Any) -> Plays:
    """Returns ended episodes on levels that were played before."""
    return _plays(seed, stage, fresh=np.zeros(len(seed), bool), **given)


def _filled(mode: str) -> LevelBuffer:
    """Returns a buffer of levels 0 to 11 with one episode each; even levels are of stage 0."""
    plays = _plays(
        np.arange(12),
        np.arange(12) % 2,
        successes=np.arange(12) // 2 % 2,
        loss=np.linspace(0.1, 1.2, 12, dtype=np.float32),
    )
    return UPDATE(levels.empty(2, 6), plays, mode, HALF, 0)


def _by_seed(buffer: LevelBuffer, name: str) -> np.ndarray:
    """Returns a column of the buffer, in the order of the levels' seeds."""
    order = np.argsort(np.asarray(buffer.seed).ravel())
    return np.asarray(getattr(buffer, name)).ravel()[order]


def _expected_learnability(successes: Any, episodes: int, usual: Any) -> np.ndarray:
    """Returns the mean of p (1 - p) over a beta distribution: its mean less its second moment."""
    a, b = successes + 2 * usual, episodes - successes + 2 * (1 - usual)
    mean = a / (a + b)
    return mean - (mean**2 + a * b / ((a + b) ** 2 * (a + b + 1)))


def test_learnability_is_the_expected_p_times_1_minus_p_over_recorded_outcomes() -> None:
    random, usual = np.random.default_rng(1), np.array([0.2, 0.9], np.float32)
    buffer, seed, stage = levels.empty(2, 6), np.arange(12), np.repeat([0, 1], 6)
    # Each level has a first episode and 15 more, with random outcomes.
    came = (random.random((16, 12)) < np.linspace(0.0, 1.0, 12)).astype(np.int32)
    for i, successes in enumerate(came):
        plays = (_again if i else _plays)(seed, stage, successes=successes)
        buffer = UPDATE(buffer, plays, LEARNABILITY, usual, i)
    expected = _expected_learnability(came.sum(axis=0), 16, usual[stage])
    np.testing.assert_allclose(_by_seed(buffer, "score"), expected, rtol=1e-5)  # float32
    assert sorted(np.asarray(buffer.seed)[0]) == [0, 1, 2, 3, 4, 5]


def test_success_of_robots_is_the_share_that_arrived() -> None:
    plays = _plays([0, 1, 2], [0] * 3, successes=[1, 3, 0], trials=[2, 4, 5])
    buffer = UPDATE(levels.empty(1, 3), plays, LEARNABILITY, np.array([0.25], np.float32), 0)
    expected = _expected_learnability(np.array([0.5, 0.75, 0.0]), 1, 0.25)
    np.testing.assert_allclose(_by_seed(buffer, "score"), expected, rtol=1e-6)  # float32


def test_value_loss_is_the_mean_of_the_newest_update() -> None:
    buffer = _filled(VALUE_LOSS)
    expected = _by_seed(buffer, "score").copy()
    plays = _again([3, 3, 7], [1, 1, 1], loss=np.array([0.4, 0.8, 2.0], np.float32))
    buffer = UPDATE(buffer, plays, VALUE_LOSS, HALF, 1)
    expected[[3, 7]] = [0.6, 2.0]
    np.testing.assert_allclose(_by_seed(buffer, "score"), expected, rtol=1e-6)  # float32


def test_sixteen_episodes_are_remembered() -> None:
    buffer = levels.empty(1, 1)
    # After forty failures and 24 successes, the failures keep a weight of (1 - 1/17)^24.
    for i, success in enumerate([0] * 40 + [1] * 24):
        plays = (_again if i else _plays)([5], [0], successes=[success])
        buffer = UPDATE(buffer, plays, LEARNABILITY, HALF[:1], i)
    expected = 16 * (1 - (16 / 17) ** 24)
    np.testing.assert_allclose(buffer.episodes, [[16.0]], rtol=1e-6)
    np.testing.assert_allclose(buffer.successes, [[expected]], rtol=1e-5)  # 24 products of float32


def _expected_probabilities(
    score: np.ndarray, age: np.ndarray, held: np.ndarray, temperature: float, staleness: float
) -> np.ndarray:
    """Returns one stage's replay probabilities, by the equations of prioritised level replay."""
    places = np.flatnonzero(held)
    ranked = places[np.argsort(-score[places], kind="stable")]
    shares = np.zeros(len(score))
    for rank, place in enumerate(ranked, 1):
        shares[place] = (1 / rank) ** (1 / temperature)
    shares = shares / shares.sum()
    stale = np.where(held, age, 0) / age[held].sum() if age[held].sum() else shares
    return (1 - staleness) * shares + staleness * stale


def test_probabilities_are_those_of_prioritised_level_replay() -> None:
    random = np.random.default_rng(2)
    score = random.random((3, 40)).astype(np.float32)
    held = random.random((3, 40)) < 0.6
    held[2] = False
    played = random.integers(0, 9, (3, 40))
    buffer = replace(
        levels.empty(3, 40),
        score=jnp.where(held, score, -1.0),
        episodes=jnp.asarray(held, jnp.float32),
        played=jnp.asarray(played),
    )
    shares = levels.probabilities(buffer, jnp.int32(9))
    for row in range(2):
        age = 9 - played[row]
        expected = _expected_probabilities(score[row], age, held[row], 2.0, 0.1)
        np.testing.assert_allclose(shares[row], expected, rtol=2e-5, atol=1e-8)  # float32, exp
    np.testing.assert_array_equal(shares[2], 0.0)


def test_levels_of_one_age_are_replayed_by_their_scores_alone() -> None:
    buffer, now = _filled(LEARNABILITY), jnp.int32(0)
    shares = levels.probabilities(buffer, now)
    for score, row in zip(np.asarray(buffer.score), shares, strict=True):
        expected = _expected_probabilities(score, np.zeros(6), score > -1.0, 2.0, 0.1)
        np.testing.assert_allclose(row, expected, rtol=2e-5)  # float32, exp


def test_a_level_is_young_again_when_an_episode_on_it_ends() -> None:
    buffer = UPDATE(_filled(LEARNABILITY), _again([2, 7], [0, 1]), LEARNABILITY, HALF, 9)
    expected = np.zeros(12, int)
    expected[[2, 7]] = 9
    assert _by_seed(buffer, "played").tolist() == expected.tolist()


def test_levels_are_chosen_as_often_as_they_are_likely() -> None:
    full = _filled(VALUE_LOSS)
    empty = jnp.array([[False] * 6, [False] * 3 + [True] * 3])
    buffer = replace(
        full,
        episodes=jnp.where(empty, 0.0, full.episodes),
        score=jnp.where(empty, -1.0, full.score),
    )
    shares = levels.probabilities(buffer, jnp.int32(0))
    picks = jax.random.uniform(jax.random.key(3), (200_000, 2))
    stage = jnp.arange(200_000) % 2
    place = np.asarray(PICK(buffer, shares, stage, picks))
    for row, share in ((0, 0.5), (1, 0.25)):  # half of the second stage's places are empty
        mine = place[np.asarray(stage) == row]
        replayed = mine[mine >= 0]
        # Four standard deviations of a share that is measured with 100,000 choices.
        assert abs(len(replayed) / len(mine) - share) < 4 * 0.5 / np.sqrt(len(mine))
        seen = np.bincount(replayed, minlength=12) / len(replayed)
        whole = np.zeros(12)
        whole[6 * row : 6 * row + 6] = shares[row]
        np.testing.assert_allclose(seen, whole, atol=4 * 0.5 / np.sqrt(len(replayed)))
        assert not seen[whole == 0.0].any()


@hypothesis.given(
    held=st.lists(st.integers(0, 5), min_size=45, max_size=45),
    pick=st.sampled_from([0.0, 2.0**-24, 0.5, 1.0 - 2.0**-23, 1.0 - 2.0**-24]),
)
def test_no_empty_place_is_chosen(held: list[int], pick: float) -> None:
    """Tests picks at either end of 0..1 as well, where float32 has few bits for 45 stages."""
    there = np.arange(5) < np.array(held)[:, None]
    buffer = replace(
        levels.empty(45, 5),
        episodes=jnp.asarray(there, jnp.float32),
        score=jnp.where(there, 0.2, -1.0),
    )
    shares = levels.probabilities(buffer, jnp.int32(0))
    picks = jnp.broadcast_to(jnp.array([0.0, pick], jnp.float32), (45, 2))
    places = np.asarray(PICK(buffer, shares, jnp.arange(45), picks))
    for stage, place in enumerate(places):
        assert (place < 0) == (held[stage] == 0)
        if place >= 0:
            assert place // 5 == stage
            assert there[stage, place % 5]


def test_the_best_that_are_new_take_the_places_of_the_worst() -> None:
    buffer = _filled(VALUE_LOSS)
    before, old = np.asarray(buffer.score), np.asarray(buffer.seed)
    random = np.random.default_rng(4)
    stage, loss = random.integers(0, 2, 30), random.random(30).astype(np.float32) * 1.5
    over, seed = random.random(30) < 0.8, np.arange(20, 50)
    after = UPDATE(buffer, _plays(seed, stage, loss=loss, over=over), VALUE_LOSS, HALF, 1)
    for row in range(2):
        mine = loss[(stage == row) & over]
        expected = np.sort(np.concatenate([before[row], mine]))[-6:]
        np.testing.assert_array_equal(np.sort(after.score[row]), expected)
        score, kept = np.asarray(after.score[row]), np.asarray(after.seed[row])
        stays = kept < 20
        np.testing.assert_array_equal(score[stays], before[row][stays])
        np.testing.assert_array_equal(kept[stays], old[row][stays])
        np.testing.assert_array_equal(score[~stays], loss[kept[~stays] - 20])


@pytest.mark.parametrize(
    "plays",
    [
        _again([0], [0], over=[False], successes=[1]),  # has not ended
        _again([77], [0], successes=[1]),  # its level has been replaced
    ],
)
def test_an_episode_that_counts_for_nothing(plays: Plays) -> None:
    buffer = _filled(LEARNABILITY)
    after = UPDATE(buffer, plays, LEARNABILITY, HALF, 1)
    jax.tree.map(np.testing.assert_array_equal, after, buffer)


def test_episodes_are_listed_with_their_outcomes() -> None:
    zero = np.zeros((2, 2), np.int32)
    ended = Ended(
        episodes=np.array([[0, 1], [1, 1]]),
        stage=np.array([[0, 1], [2, 1]]),
        cohort=np.array([[-1, 3], [UNCOUNTED, 3]]),
        targets=np.array([[0, 4], [5, 4]]),
        reached=np.array([[0, 2], [5, 1]]),
        all_reached=np.array([[0, 0], [1, 0]]),
        steps=zero,
        robot_steps=zero,
        sensed=zero,
        contacts=zero,
        reward=zero,
        broken=zero,
        level=np.array([[0, 7], [8, 9]], np.uint32),
    )
    ended = jax.tree.map(lambda x: jnp.tile(x, (8, 1)), ended)  # room for 4 of 24 episodes
    loss = jnp.tile(jnp.array([[0.0, 0.5], [0.25, 1.0]]), (8, 1))
    plays = levels.list_plays(ended, loss, CurriculumConfig())
    assert plays.over.tolist() == [True] * 4
    assert plays.seed.tolist() == [7, 8, 9, 7]
    assert plays.stage.tolist() == [1, 2, 1, 1]
    assert plays.fresh.tolist() == [True, False, True, True]
    assert (plays.successes.tolist(), plays.trials.tolist()) == ([2, 5, 1, 2], [4, 5, 4, 4])
    assert plays.loss.tolist() == [0.5, 0.25, 1.0, 0.5]
    whole = levels.list_plays(ended, loss, CurriculumConfig(success="all"))
    assert (whole.successes.tolist(), whole.trials.tolist()) == ([0, 1, 0, 0], [1] * 4)


def _find(seed: int) -> tuple[int, float]:
    """Plays a thousand levels: one succeeds half of the time, the others never or always.

    Returns:
      The level with the best score after 400 updates, and the share of the learnable level in the
      replays of the last hundred updates.
    """
    arenas, one = 64, 617
    truth = np.where(np.arange(1000) % 2, 1.0, 0.0)
    truth[one] = 0.5
    random, buffer = np.random.default_rng(seed), levels.empty(1, 128)
    stage, replayed = np.zeros(arenas, np.int32), []
    for update in range(400):
        shares = levels.probabilities(buffer, jnp.int32(update))
        picks = random.random((arenas, 2), dtype=np.float32)
        place = np.asarray(PICK(buffer, shares, stage, picks))
        fresh = random.integers(0, 1000, arenas)
        which = np.where(place < 0, fresh, np.asarray(buffer.seed)[0, place])
        came = (random.random(arenas) < truth[which]).astype(np.int32)
        plays = _plays(which, stage, fresh=place < 0, successes=came)
        buffer = UPDATE(buffer, plays, LEARNABILITY, HALF[:1], update)
        replayed += [*which[place >= 0]] if update >= 300 else []
    best = int(buffer.seed[0, int(jnp.argmax(buffer.score[0]))])
    return best, float(np.mean(np.array(replayed) == one))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_one_learnable_level_among_a_thousand_is_found(seed: int) -> None:
    best, share = _find(seed)
    assert best == 617
    # With random draws, the share would be one in a thousand.
    assert share > 0.05
