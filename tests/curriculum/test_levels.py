"""Checks the buffer of levels against NumPy: scores, choices, and which levels are kept."""

from dataclasses import replace
from typing import Any

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from swarmjax.config import ConfigError, build
from swarmjax.curriculum import levels
from swarmjax.curriculum.config import LevelsConfig
from swarmjax.curriculum.levels import FRESH, LOST, MUTATED, LevelBuffer, LevelNumbers, Play

LEARNABILITY = LevelsConfig(mode="learnability", buffer=12)
FAILURE = LevelsConfig(mode="failure", buffer=12)
VALUE_LOSS = LevelsConfig(mode="value_loss", buffer=12)
UPDATE, CHOOSE = jax.jit(levels.update, static_argnums=2), jax.jit(levels.choose)
MUTATE = jax.jit(levels.mutate)


def _options(**given: float) -> LevelNumbers:
    found = {"replay": 0.5, "mutation": 0.0, "temperature": 2.0, "staleness": 0.0, **given}
    return LevelNumbers(
        **{key: np.float32(value) for key, value in found.items()}, minimum_episodes=np.int32(4)
    )


def _plays(slot: Any, stage: Any, **given: Any) -> Play:
    """Returns episodes that began and ended, with one trial each.

    Each level is one number: by default its place in the list.
    """
    count = len(slot)
    found = {
        "begun": np.ones(count, bool),
        "ended": np.ones(count, bool),
        "successes": np.zeros(count, np.int32),
        "trials": np.ones(count, np.int32),
        "loss": np.zeros(count, np.float32),
        "numbers": np.arange(count, dtype=np.float32)[:, None],
        "generation": np.zeros(count, np.int32),
        **given,
    }
    slot, stage = np.asarray(slot, np.int32), np.asarray(stage, np.int32)
    return Play(slot, stage, **{key: jnp.asarray(value) for key, value in found.items()})


def _filled(config: LevelsConfig, stages: int = 2) -> LevelBuffer:
    """Returns a buffer of twelve levels with one episode each, with various outcomes and losses.

    With two stages, each stage has six levels.
    """
    plays = _plays(
        [FRESH] * 12,
        np.arange(12) % stages,
        successes=np.arange(12) // 2 % 2,
        loss=np.linspace(0.1, 1.2, 12, dtype=np.float32),
    )
    buffer = levels.init(stages, 12, 1)
    return UPDATE(buffer, plays, config, np.full(stages, 0.5, np.float32))[0]


def _expected_learnability(successes: Any, episodes: int, usual: Any) -> np.ndarray:
    """Returns the mean of p (1 - p) over a beta distribution: its mean less its second moment."""
    a, b = successes + 2 * usual, episodes - successes + 2 * (1 - usual)
    mean = a / (a + b)
    return mean - (mean**2 + a * b / ((a + b) ** 2 * (a + b + 1)))


def test_learnability_is_the_expected_p_times_1_minus_p_over_recorded_outcomes() -> None:
    random, usual = np.random.default_rng(1), np.array([0.2, 0.9], np.float32)
    buffer = levels.init(2, 12, 1)
    # Each level has a first episode and 15 more, with random outcomes.
    came = random.random((16, 12)) < np.linspace(0.0, 1.0, 12)
    at, stage = np.arange(12), np.repeat([0, 1], 6)
    for i, episode in enumerate(came):
        slot = np.full(12, FRESH) if i == 0 else at
        buffer, _ = UPDATE(
            buffer,
            _plays(slot, stage, successes=episode.astype(np.int32)),
            LEARNABILITY,
            usual,
        )
    numbers = np.asarray(buffer.numbers[..., 0]).ravel().astype(int)  # the level in each place
    assert sorted(numbers) == list(range(12))
    first = came[0][numbers]
    successes = first + came[1:].sum(axis=0)
    expected = _expected_learnability(successes, 16, usual[stage])
    np.testing.assert_allclose(np.asarray(buffer.score).ravel(), expected, rtol=1e-5)  # float32


def test_failure_is_the_expected_1_minus_p() -> None:
    usual, first = np.array([0.8], np.float32), np.arange(12) % 2
    buffer = levels.init(1, 12, 1)
    buffer, _ = UPDATE(buffer, _plays([FRESH] * 12, [0] * 12, successes=first), FAILURE, usual)
    # A second episode on each level fails.
    buffer, _ = UPDATE(buffer, _plays(np.arange(12), [0] * 12), FAILURE, usual)
    # One or two of two episodes failed. They are added to a prior of two episodes, of which 20 %
    # fail.
    expected = [1.4 / 4] * 6 + [2.4 / 4] * 6
    np.testing.assert_allclose(np.sort(buffer.score[0]), expected, rtol=1e-6)  # float32


def test_success_of_robots_is_the_share_that_arrived() -> None:
    plays = _plays([FRESH] * 3, [0] * 3, successes=[1, 3, 0], trials=[2, 4, 5])
    buffer, _ = UPDATE(
        levels.init(1, 3, 1), plays, LevelsConfig(mode="learnability"), np.array([0.25], np.float32)
    )
    expected = np.sort(_expected_learnability(np.array([0.5, 0.75, 0.0]), 1, 0.25))
    np.testing.assert_allclose(np.sort(buffer.score[0]), expected, rtol=1e-6)  # float32


def test_value_loss_is_the_mean_of_the_newest_update() -> None:
    buffer = _filled(VALUE_LOSS)
    before = np.asarray(buffer.score).ravel()
    plays = _plays([3, 3, 7], [0, 0, 1], loss=np.array([0.4, 0.8, 2.0], np.float32))
    buffer, _ = UPDATE(buffer, plays, VALUE_LOSS, np.full(2, 0.5, np.float32))
    expected = before.copy()
    expected[[3, 7]] = [0.6, 2.0]
    np.testing.assert_allclose(np.asarray(buffer.score).ravel(), expected, rtol=1e-6)  # float32


def test_sixteen_episodes_are_remembered() -> None:
    buffer = levels.init(1, 1, 1)
    usual = np.array([0.5], np.float32)
    # After forty failures and 24 successes, the failures keep a weight of (1 - 1/17)^24.
    for i, success in enumerate([0] * 40 + [1] * 24):
        plays = _plays([FRESH if i == 0 else 0], [0], successes=[success])
        buffer, _ = UPDATE(buffer, plays, LEARNABILITY, usual)
    expected = 16 * (1 - (16 / 17) ** 24)
    np.testing.assert_allclose(buffer.episodes, [[16.0]], rtol=1e-6)
    np.testing.assert_allclose(buffer.successes, [[expected]], rtol=1e-5)  # 24 products of float32


def _expected_probabilities(
    score: np.ndarray, age: np.ndarray, held: np.ndarray, temperature: float, staleness: float
) -> np.ndarray:
    """Returns one stage's replay probabilities, by the equations of prioritised level replay."""
    places = np.flatnonzero(held)
    ranked = places[np.argsort(-score[places], kind="stable")]
    found = np.zeros(len(score))
    for rank, place in enumerate(ranked, 1):
        found[place] = (1 / rank) ** (1 / temperature)
    found = found / found.sum()
    stale = np.where(held, age, 0) / age[held].sum() if age[held].sum() else found
    return (1 - staleness) * found + staleness * stale


@pytest.mark.parametrize("temperature", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("staleness", [0.0, 0.3])
def test_probabilities_are_those_of_prioritised_level_replay(
    temperature: float, staleness: float
) -> None:
    random = np.random.default_rng(2)
    score = random.random((3, 40)).astype(np.float32)
    held = random.random((3, 40)) < 0.6
    held[2] = False
    begun = random.integers(0, 9, (3, 40))
    buffer = replace(
        levels.init(3, 120, 1),
        score=jnp.where(held, score, -1.0),
        episodes=jnp.asarray(held, jnp.float32),
        begun=jnp.asarray(begun),
        clock=jnp.int32(9),
    )
    options = _options(temperature=temperature, staleness=staleness)
    found = levels.probabilities(buffer, options)
    for row in range(2):
        expected = _expected_probabilities(
            score[row], 9 - begun[row], held[row], temperature, staleness
        )
        np.testing.assert_allclose(found[row], expected, rtol=2e-5, atol=1e-8)  # float32, exp
    np.testing.assert_array_equal(found[2], 0.0)


def test_levels_of_one_age_are_replayed_by_their_scores_alone() -> None:
    buffer = _filled(LEARNABILITY)
    same = replace(buffer, begun=jnp.full_like(buffer.begun, buffer.clock))
    found = levels.probabilities(same, _options(staleness=0.3))
    expected = levels.probabilities(same, _options(staleness=0.0))
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # float32: 0.7 p + 0.3 p


def test_only_levels_that_begin_are_fresh() -> None:
    buffer = _filled(LEARNABILITY)
    later = replace(buffer, clock=jnp.int32(9))
    plays = _plays([2, 7], [0, 1], begun=np.array([True, False]))
    buffer, _ = UPDATE(later, plays, LEARNABILITY, np.full(2, 0.5, np.float32))
    expected = np.array(later.begun).ravel()
    expected[2] = 9
    assert np.asarray(buffer.begun).ravel().tolist() == expected.tolist()


def test_means_are_over_the_levels_that_are_held() -> None:
    plays = _plays([FRESH] * 2, [0, 0], successes=[1, 0], generation=[4, 1])
    buffer, _ = UPDATE(levels.init(2, 12, 1), plays, LEARNABILITY, np.full(2, 0.5, np.float32))
    found = levels.describe(buffer, plays)
    assert found["levels_held"].tolist() == [2, 0]
    assert float(found["levels_success"][0]) == 0.5
    assert float(found["levels_generation"][0]) == 2.5
    assert np.isnan(found["levels_success"][1])


def test_levels_are_chosen_as_often_as_they_are_likely() -> None:
    full = _filled(VALUE_LOSS)
    empty = jnp.array([[False] * 6, [False] * 3 + [True] * 3])
    buffer = replace(
        full,
        episodes=jnp.where(empty, 0.0, full.episodes),
        score=jnp.where(empty, -1.0, full.score),
    )
    options = _options(replay=0.8, temperature=1.0)
    picks = jax.random.uniform(jax.random.key(3), (200_000, 2))
    stage = jnp.arange(200_000) % 2
    found = np.asarray(CHOOSE(buffer, options, stage, picks))
    for row, share in ((0, 0.8), (1, 0.4)):  # half of the second stage's places are empty
        mine = found[np.asarray(stage) == row]
        replayed = mine[mine != FRESH]
        # Four standard deviations of a share that is measured with 100,000 choices.
        assert abs(len(replayed) / len(mine) - share) < 4 * 0.5 / np.sqrt(len(mine))
        seen = np.bincount(replayed, minlength=12) / len(replayed)
        expected = np.asarray(levels.probabilities(buffer, options))[row]
        whole = np.zeros(12)
        whole[6 * row : 6 * row + 6] = expected
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
        levels.init(45, 225, 1),
        episodes=jnp.asarray(there, jnp.float32),
        score=jnp.where(there, 0.2, -1.0),
    )
    picks = jnp.broadcast_to(jnp.array([0.0, pick], jnp.float32), (45, 2))
    found = np.asarray(CHOOSE(buffer, _options(), jnp.arange(45), picks))
    for stage, slot in enumerate(found):
        assert (slot == FRESH) == (held[stage] == 0)
        if slot != FRESH:
            assert slot // 5 == stage
            assert there[stage, slot % 5]


def test_the_best_that_are_new_take_the_places_of_the_worst() -> None:
    buffer = _filled(VALUE_LOSS)
    before = np.asarray(buffer.score)
    random = np.random.default_rng(4)
    stage, loss = random.integers(0, 2, 30), random.random(30).astype(np.float32) * 1.5
    slot = np.where(random.random(30) < 0.5, FRESH, MUTATED)
    ended = random.random(30) < 0.8
    plays = _plays(slot, stage, loss=loss, ended=ended, numbers=loss[:, None])
    after, taken = UPDATE(buffer, plays, VALUE_LOSS, np.full(2, 0.5, np.float32))
    for row in range(2):
        mine = loss[(stage == row) & ended]
        expected = np.sort(np.concatenate([before[row], mine]))[-6:]
        np.testing.assert_array_equal(np.sort(after.score[row]), expected)
        # A level that stays keeps its place, so that running episodes find it.
        stays = ~np.asarray(taken).reshape(2, 6)[row]
        np.testing.assert_array_equal(np.asarray(after.score[row])[stays], before[row][stays])
        new = np.asarray(after.numbers[row, :, 0])[~stays]
        np.testing.assert_array_equal(new, np.asarray(after.score[row])[~stays])


def test_what_has_not_ended_or_was_lost_counts_for_nothing() -> None:
    buffer = _filled(LEARNABILITY)
    plays = _plays([0, FRESH, LOST], [0, 0, 0], ended=[False, False, True], successes=[1, 1, 1])
    after, taken = UPDATE(buffer, plays, LEARNABILITY, np.full(2, 0.5, np.float32))
    assert not np.asarray(taken).any()
    for name in ("episodes", "successes", "score"):
        np.testing.assert_array_equal(getattr(after, name), getattr(buffer, name), err_msg=name)
    assert int(after.begun[0, 0]) == 1  # the episode began all the same


def test_a_place_that_was_taken_is_lost() -> None:
    taken = jnp.arange(12) == 5
    slot = jnp.array([5, 4, FRESH, MUTATED, LOST])
    np.testing.assert_array_equal(levels.mark_lost(slot, taken), [LOST, 4, FRESH, MUTATED, LOST])


def _find(temperature: float, seed: int) -> tuple[int, float]:
    """Plays a thousand levels: one succeeds half of the time, the others never or always.

    Returns:
      The level with the best score after 400 updates, and the share of the learnable level in the
      replays of the last hundred updates.
    """
    arenas, config = 64, LevelsConfig(mode="learnability", buffer=128)
    options, one = _options(temperature=temperature, staleness=0.1), 617
    truth = np.where(np.arange(1000) % 2, 1.0, 0.0)
    truth[one] = 0.5
    random, buffer = np.random.default_rng(seed), levels.init(1, 128, 1)
    stage, replayed = np.zeros(arenas, np.int32), []
    for update in range(400):
        picks = random.random((arenas, 2), dtype=np.float32)
        slot = np.asarray(CHOOSE(buffer, options, stage, picks))
        fresh = random.integers(0, 1000, arenas)
        which = np.where(slot == FRESH, fresh, np.asarray(buffer.numbers)[0, slot, 0].astype(int))
        came = (random.random(arenas) < truth[which]).astype(np.int32)
        plays = _plays(slot, stage, successes=came, numbers=which[:, None].astype(np.float32))
        buffer, _ = UPDATE(buffer, plays, config, np.array([0.5], np.float32))
        replayed += [*which[slot != FRESH]] if update >= 300 else []
    best = int(buffer.numbers[0, int(jnp.argmax(buffer.score[0])), 0])
    return best, float(np.mean(np.array(replayed) == one))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_one_learnable_level_among_a_thousand_is_found(seed: int) -> None:
    best, share = _find(1.0, seed)
    assert best == 617
    # With random draws, the share would be one in a thousand.
    assert share > 0.1


@hypothesis.given(
    numbers=st.lists(st.floats(0.0, 1.0, exclude_max=True, width=32), min_size=6, max_size=6),
    picks=st.tuples(*[st.floats(0.0, 1.0, exclude_max=True, width=32)] * 2),
)
def test_a_mutation_moves_one_number_and_keeps_it_inside(
    numbers: list[float], picks: tuple[float, float]
) -> None:
    given, movable = np.array(numbers, np.float32), np.array([0, 1, 0, 1, 1, 0], np.float32)
    found = np.asarray(MUTATE(given, movable, np.array(picks, np.float32)))
    moved = np.flatnonzero(found != given)
    assert len(moved) <= 1
    assert set(moved) <= {1, 3, 4}
    assert (found >= 0.0).all()
    assert (found < 1.0).all()
    assert np.abs(found - given).max() <= 0.25 + 1e-6  # float32


def test_a_mutation_chooses_evenly_and_moves_both_ways() -> None:
    movable = np.array([0, 1, 0, 1, 1], np.float32)
    picks = jax.random.uniform(jax.random.key(0), (30_000, 2))
    given = np.full(5, 0.5, np.float32)
    found = jax.vmap(lambda each: levels.mutate(given, movable, each))(picks) - given
    share = np.mean(np.asarray(found) != 0.0, axis=0)
    np.testing.assert_allclose(share, [0, 1 / 3, 0, 1 / 3, 1 / 3], atol=0.012)  # 4 deviations
    assert np.abs(np.mean(found)) < 0.001
    assert np.abs(found).max() > 0.249


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (
            {"mutation": 0.2},
            "mutation is 0.2, but mode is random, which has no buffer: mutation is an option of "
            "learnability, failure and value_loss, so give null or mode=learnability.",
        ),
        (
            {"buffer": 100},
            "buffer is 100, but mode is random, which has no buffer: buffer is an option of "
            "learnability, failure and value_loss, so give null or mode=learnability.",
        ),
        ({"mode": "learnability", "replay": 1.5}, "replay is 1.5: give more than 0, less than 1."),
        ({"mode": "learnability", "mutation": -0.1}, "mutation is -0.1: give 0 to 1."),
        ({"mode": "value_loss", "buffer": 2**21}, "buffer is 2097152: give 1 to 1048576."),
    ],
)
def test_bad_options_are_refused_in_one_sentence(given: dict, sentence: str) -> None:
    with pytest.raises(ConfigError) as error:
        build(LevelsConfig, given)
    assert str(error.value) == sentence


def test_a_buffer_has_its_defaults_and_none_has_none() -> None:
    on, off = LevelsConfig(mode="learnability"), LevelsConfig()
    assert (on.buffer, on.replay, on.mutation, on.temperature) == (4096, 0.5, 0.0, 2.0)
    assert (on.staleness, on.minimum_episodes) == (0.1, 4)
    assert {getattr(off, key) for key in vars(off) if key != "mode"} == {None}
