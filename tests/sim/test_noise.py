"""Tests the random numbers: an integer reference, NumPy against JAX, and fairness."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream

COUNT = 100_000
WORD = 2**32
SEED = st.integers(0, WORD - 1)
CLOCK = st.integers(0, 2**31 - 1)
# NumPy and XLA differ by an ulp or two in log, cos and sin. The Box-Muller radius is at most 5.8.
ULPS = 2e-6
# A standard normal number is farther than 4.42 from 0 with probability 1e-5, so a fair generator
# rarely fails.
FAR = 4.42

# Each layout draws its numbers along one input of the hash: seed, clock, index or stream. A stream
# is a plain int, so the layout "stream" needs one call for each stream.
LAYOUTS = ["seed", "clock", "index", "stream"]


def _drawn(kind: str, layout: str) -> np.ndarray:
    """Returns [COUNT] uniform or normal numbers, drawn along one of `LAYOUTS`."""
    draw = getattr(noise, kind)
    run = np.arange(COUNT, dtype=np.uint32)
    if layout == "seed":
        return draw(run, 3, Stream.MASS, (), np)
    if layout == "clock":
        return draw(np.uint32(3), run, Stream.MASS, (), np)
    if layout == "index":
        return draw(np.uint32(3), 3, Stream.MASS, (COUNT,), np)
    seeds = run[: COUNT // 50]
    return np.stack([draw(seeds, 3, s, (), np) for s in range(50)], axis=-1).reshape(-1)


# --- which numbers


def _mix(word: int) -> int:
    """Hashes a word with `triple32inc`, in Python's integers of unlimited size."""
    word = (word + 1) % WORD
    word = (word ^ word >> 17) * 0xED5AD4BB % WORD
    word = (word ^ word >> 11) * 0xAC4C1B51 % WORD
    word = (word ^ word >> 15) * 0x31848BAB % WORD
    return word ^ word >> 14


@given(SEED, CLOCK, st.integers(0, 63))
def test_bits_are_the_hash_of_seed_clock_stream_and_index(
    seed: int, clock: int, stream: int
) -> None:
    key = _mix(_mix(_mix(_mix(seed)) ^ _mix(clock)) ^ _mix(stream))
    expected = [[_mix(key ^ _mix(2 * row + column)) for column in range(2)] for row in range(3)]
    for xp in (np, jnp):
        found = noise.bits(xp.uint32(seed), xp.int32(clock), stream, (3, 2), xp)
        assert found.dtype == np.uint32
        np.testing.assert_array_equal(found, expected)


def test_streams_differ() -> None:
    assert len(Stream) == len(Stream.__members__)  # len(Stream) counts equal values once
    found = {int(noise.bits(np.uint32(1), 0, stream, (), np)) for stream in Stream}
    assert len(found) == len(Stream)


def test_uniform_is_the_upper_24_bits() -> None:
    bits = noise.bits(np.uint32(5), 2, Stream.ACTION, (1000,), np)
    found = noise.uniform(np.uint32(5), 2, Stream.ACTION, (1000,), np)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, (bits // 256) / 2**24)


def test_normal_is_box_and_muller() -> None:
    drawn = noise.uniform(np.uint32(5), 2, Stream.ACTION, (500, 2), np).astype(float)
    expected = [
        math.sqrt(-2 * math.log(1 - u)) * f(2 * math.pi * v)
        for u, v in drawn
        for f in (math.cos, math.sin)
    ]
    found = noise.normal(np.uint32(5), 2, Stream.ACTION, (999,), np)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected[:999], atol=ULPS)


def test_ends_of_the_range() -> None:
    # Found by search: the upper 24 bits are all 0 for the first seed and all 1 for the second.
    seeds = np.array([36119314, 1173731], np.uint32)
    np.testing.assert_array_equal(
        noise.uniform(seeds, 0, 0, (), np), np.array([0, 1 - 2**-24], np.float32)
    )
    pairs = noise.normal(seeds, 0, 0, (2,), np)
    np.testing.assert_array_equal(pairs[0], 0.0)
    # The largest radius is sqrt(2 * 24 * log(2)), where 1e-6 is 2 ulp.
    assert math.hypot(*pairs[1]) == pytest.approx(5.768108, abs=1e-6)


# --- NumPy and JAX, axes


@pytest.mark.parametrize("kind", ["bits", "uniform", "normal"])
@pytest.mark.parametrize("shape", [(), (7,), (4, 8), (3, 8, 2)])
def test_numpy_and_jax_draw_the_same_numbers(kind: str, shape: tuple[int, ...]) -> None:
    draw = getattr(noise, kind)
    seeds = np.random.default_rng(0).integers(0, WORD, 50, dtype=np.uint32)
    clocks = np.arange(50, dtype=np.int32)

    def arena(seed: jax.Array, clock: jax.Array) -> jax.Array:
        return draw(seed, clock, Stream.INFRARED, shape, jnp)

    expected = draw(seeds, clocks, Stream.INFRARED, shape, np)
    mapped = jax.jit(jax.vmap(arena))(seeds, clocks)
    led = jax.jit(arena)(seeds, clocks)
    assert expected.shape == mapped.shape == led.shape == (50, *shape)
    assert expected.dtype == mapped.dtype == led.dtype
    tolerance = ULPS if kind == "normal" else 0
    np.testing.assert_allclose(mapped, expected, rtol=0, atol=tolerance)
    np.testing.assert_allclose(led, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", ["bits", "uniform", "normal"])
def test_leading_axes_are_single_draws(kind: str) -> None:
    draw = getattr(noise, kind)
    seeds = np.arange(6, dtype=np.uint32).reshape(2, 3)
    clocks = 10 * seeds.astype(np.int32)
    both = draw(seeds, clocks, Stream.ACTION, (5,), np)
    common = draw(seeds, 7, Stream.ACTION, (5,), np)
    # Bits and uniform numbers agree exactly. NumPy's SIMD and scalar code for log and cos may
    # differ in the last bits.
    tolerance = ULPS if kind == "normal" else 0
    for place in np.ndindex(2, 3):
        one = draw(seeds[place], int(clocks[place]), Stream.ACTION, (5,), np)
        np.testing.assert_allclose(both[place], one, rtol=0, atol=tolerance)
        one = draw(seeds[place], 7, Stream.ACTION, (5,), np)
        np.testing.assert_allclose(common[place], one, rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", ["bits", "uniform", "normal"])
def test_more_robots_leave_the_numbers_of_the_first_alone(kind: str) -> None:
    draw = getattr(noise, kind)
    few, many = (draw(np.uint32(9), 4, Stream.ACTION, (n, 3), np) for n in (3, 8))
    tolerance = ULPS if kind == "normal" else 0  # as above
    np.testing.assert_allclose(few, many[:3], rtol=0, atol=tolerance)


# --- quality


@pytest.mark.parametrize("layout", LAYOUTS)
def test_uniform_numbers_are_even(layout: str) -> None:
    found = _drawn("uniform", layout).astype(float)
    assert found.min() >= 0.0
    assert found.max() < 1.0
    counts = np.histogram(found, bins=1000, range=(0.0, 1.0))[0]
    assert stats.chisquare(counts).pvalue > 1e-5  # A fair generator fails in 1 of 1e5 runs.
    # The mean has a standard deviation of sqrt(1/12/n). The mean squared distance from 1/2 has a
    # standard deviation of sqrt(1/180/n).
    assert abs(found.mean() - 0.5) < FAR * math.sqrt(1 / 12 / COUNT)
    assert abs(((found - 0.5) ** 2).mean() - 1 / 12) < FAR * math.sqrt(1 / 180 / COUNT)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_normal_numbers_are_normal(layout: str) -> None:
    found = _drawn("normal", layout).astype(float)
    # The means of z, z**2, z**3 and z**4 have the variances 1/n, 2/n, 15/n and 96/n.
    for power, (mean, variance) in enumerate([(0, 1), (1, 2), (0, 15), (3, 96)], start=1):
        assert abs((found**power).mean() - mean) < FAR * math.sqrt(variance / COUNT), power
    assert stats.kstest(found, "norm").pvalue > 1e-5  # A fair generator fails in 1 of 1e5 runs.


@pytest.mark.parametrize("kind", ["uniform", "normal"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_neighbours_know_nothing_of_each_other(kind: str, layout: str) -> None:
    found = _drawn(kind, layout).astype(float)
    place = stats.norm.cdf(found) if kind == "normal" else found
    for lag in (1, 2, 3, 8, 16, 40, 1024):
        first, second = place[:-lag], place[lag:]
        # The correlation of n independent pairs has a standard deviation of 1 / sqrt(n).
        correlation = np.corrcoef(first, second)[0, 1]
        assert abs(correlation) < FAR / math.sqrt(len(first)), (lag, correlation)
        # Pairs must also fall evenly into 16 x 16 bins, which finds dependence beyond correlation.
        # This takes only half of the pairs, none of which shares a number with another pair.
        apart = np.flatnonzero((np.arange(len(first)) // lag) % 2 == 0)
        counts = np.histogram2d(first[apart], second[apart], bins=16, range=[(0, 1), (0, 1)])[0]
        assert stats.chisquare(counts.reshape(-1)).pvalue > 1e-5, lag  # as above


@pytest.mark.parametrize("layout", LAYOUTS)
def test_streams_clocks_and_seeds_know_nothing_of_each_other(layout: str) -> None:
    # Draws many numbers twice, with a seed, clock, stream or index that differs by one.
    run = np.arange(COUNT, dtype=np.uint32)
    other = {
        "seed": lambda d: noise.uniform(run + np.uint32(d), 3, 4, (), np),
        "clock": lambda d: noise.uniform(run, 3 + d, 4, (), np),
        "stream": lambda d: noise.uniform(run, 3, 4 + d, (), np),
        "index": lambda d: noise.uniform(run, 3, 4, (2,), np)[:, d],
    }[layout]
    correlation = np.corrcoef(other(0), other(1))[0, 1]
    assert abs(correlation) < FAR / math.sqrt(COUNT)


@pytest.mark.parametrize("layout", ["seed", "clock"])
def test_each_bit_flips_half_of_the_bits(layout: str) -> None:
    run = np.random.default_rng(1).integers(0, 2**31, 4096, dtype=np.uint32)
    for bit in range(31):
        turned = run ^ np.uint32(1 << bit)
        if layout == "seed":
            change = noise.bits(run, 0, 0, (), np) ^ noise.bits(turned, 0, 0, (), np)
        else:
            change = noise.bits(run * 0, run, 0, (), np) ^ noise.bits(run * 0, turned, 0, (), np)
        share = np.unpackbits(change.view(np.uint8)).reshape(4096, 32).mean(axis=0)
        # The share of ones in 4096 fair bits has a standard deviation of 1/128. The worst of the
        # 1,984 shares of both layouts exceeds 5.5 deviations with probability 8e-5.
        assert np.abs(share - 0.5).max() < 5.5 / 128, bit


def test_runs_of_numbers_do_not_meet() -> None:
    # 64 seeds, 64 clocks, 2 streams and 32 indices give 2**18 words. By chance
    # 2**36 / 2 / 2**32 = 8 pairs of words agree. Thousands of pairs would agree if the hash only
    # added two of its inputs, such as seed and clock, or if two inputs could change places.
    seeds, clocks = np.meshgrid(np.arange(64, dtype=np.uint32), np.arange(64))
    words = np.stack([noise.bits(seeds, clocks, stream, (32,), np) for stream in (0, 1)])
    pairs = words.size - len(np.unique(words))
    assert pairs < 30  # a Poisson number of mean 8 reaches 30 with probability 2e-9
