"""Tests latency and stalls of commands step by step by hand, and speeds against the firmware."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.sim import motor, noise
from swarmjax.sim.motor import Motor
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig

STEP = 0.032  # s
IDEAL = RealismConfig()
LATE = RealismConfig(action_latency=(0, 2))
RATE = 2 * math.pi / 1000  # rad/s at one step per second
SEED = np.uint32(11)


def _run(
    realism: RealismConfig,
    commands: np.ndarray,
    latency: np.ndarray | None = None,
    xp: Any = np,
    seed: Any = SEED,
) -> tuple[np.ndarray, list[Motor | None]]:
    """Delivers commands [T, R, 2]; returns the commands that arrived, [T, R, 2], and the states."""
    state = motor.init(realism, commands.shape[1], xp)
    late = None if latency is None else xp.asarray(latency)
    arrived, states = [], [state]
    for clock, command in enumerate(commands):
        state, now = motor.deliver(
            state, xp.asarray(command), late, realism, seed, xp.int32(clock), STEP, xp
        )
        arrived.append(np.asarray(now))
        states.append(state)
    return np.stack(arrived), states


def _numbered(steps: int, robots: int) -> np.ndarray:
    """Returns commands [T, R, 2] that encode control step and robot: (step + 1, -(robot + 1))."""
    first, second = np.meshgrid(np.arange(1, steps + 1), -np.arange(1, robots + 1), indexing="ij")
    return np.stack([first, second], axis=-1).astype(np.float32)


def _stall_begins(seed: Any, clock: int, robots: int, realism: RealismConfig) -> np.ndarray:
    """Returns whether a stall would begin, [R], from the numbers that `deliver` documents."""
    drawn = noise.uniform(seed, clock, Stream.STALL, (robots,), np)
    return drawn < np.float32(realism.stall)


# --- latency


def test_a_command_arrives_after_its_latency() -> None:
    commands = _numbered(6, 3)
    arrived, states = _run(LATE, commands, np.array([0, 1, 2], np.int32))
    # The robots have latencies of 0, 1 and 2 control steps. Before the first command arrives, the
    # command is zero.
    np.testing.assert_array_equal(arrived[:, 0, 0], [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(arrived[:, 1, 0], [0, 1, 2, 3, 4, 5])
    np.testing.assert_array_equal(arrived[:, 2, 0], [0, 0, 1, 2, 3, 4])
    np.testing.assert_array_equal(arrived[:, 1, 1], [0, -2, -2, -2, -2, -2])
    last = states[-1]
    assert last is not None
    assert last.held is None
    assert last.applied is None
    np.testing.assert_array_equal(last.queue, commands[[5, 4]])  # newest first


def test_the_state_holds_what_is_needed_and_no_more() -> None:
    none = [IDEAL, RealismConfig(action_latency=(0, 0)), RealismConfig(stall_time=(1.0, 2.0))]
    assert [motor.init(realism, 4, np) for realism in none] == [None, None, None]
    late = motor.init(RealismConfig(action_latency=(1, 3)), 4, np)
    stalling = motor.init(RealismConfig(stall=0.5, action_latency=(0, 0)), 4, np)
    assert late is not None
    assert stalling is not None
    assert late.queue is not None
    assert late.queue.shape == (3, 4, 2)
    assert late.held is None
    assert late.applied is None
    assert stalling.queue is None
    np.testing.assert_array_equal(stalling.held, [0, 0, 0, 0])
    np.testing.assert_array_equal(stalling.applied, np.zeros((4, 2)))


def test_without_latency_and_stalls_commands_pass_untouched() -> None:
    commands = _numbered(2, 3)
    assert _run(IDEAL, commands)[1] == [None] * 3
    np.testing.assert_array_equal(_run(IDEAL, commands)[0], commands)
    # A latency of up to 2 for other robots and a stall probability of 0 do not change the commands
    # of robots with latency 0.
    quiet = RealismConfig(action_latency=(0, 2), stall=0.0)
    np.testing.assert_array_equal(_run(quiet, commands, np.zeros(3, np.int32))[0], commands)


# --- stalls


def test_a_stall_holds_the_last_delivered_command() -> None:
    # 0.1 s / 0.032 s = 3.1, so that each stall lasts 3 control steps.
    realism = RealismConfig(stall=0.15, stall_time=(0.1, 0.1))
    commands = _numbered(60, 4)
    arrived, _ = _run(realism, commands)
    expected = np.zeros((60, 4))
    begun = 0
    for robot in range(4):
        last, left = 0.0, 0
        for t in range(60):
            if left == 0 and _stall_begins(SEED, t, 4, realism)[robot]:
                left, begun = 3, begun + 1
            if left > 0:
                left -= 1
            else:
                last = t + 1.0
            expected[t, robot] = last
    assert begun > 10  # otherwise the seed tests little
    np.testing.assert_array_equal(arrived[..., 0], expected)


def test_a_stall_that_runs_is_left_alone_and_ends_on_time() -> None:
    realism = RealismConfig(stall=0.0)
    state = Motor(None, np.array([3, 0], np.int32), np.array([[7.0, 8.0], [7.0, 8.0]]))
    found = []
    for clock in range(5):
        command = np.full((2, 2), clock + 1.0)
        state, now = motor.deliver(state, command, None, realism, SEED, clock, STEP, np)
        assert state is not None
        assert state.held is not None
        found.append([*now[:, 0], *state.held])
    # Each row holds the commands of robots 0 and 1, and the control steps left of their stalls.
    assert found == [[7, 1, 2, 0], [7, 2, 1, 0], [7, 3, 0, 0], [4, 4, 0, 0], [5, 5, 0, 0]]


def test_a_robot_that_always_stalls_never_moves() -> None:
    arrived, _ = _run(RealismConfig(stall=1.0), _numbered(30, 2))
    np.testing.assert_array_equal(arrived, 0.0)


def test_stalls_begin_as_often_and_last_as_long_as_asked() -> None:
    realism = RealismConfig(stall=0.02, stall_time=(0.1, 0.3))
    seeds, robots = np.arange(40_000, dtype=np.uint32), 5
    state = Motor(
        None, np.zeros((40_000, robots), np.int32), np.zeros((40_000, robots, 2), np.float32)
    )
    command = np.ones((40_000, robots, 2), np.float32)
    state, now = motor.deliver(state, command, None, realism, seeds, 6, STEP, np)
    begun = now[..., 0] == 0.0
    assert state is not None
    # The mean of 200,000 draws has a standard deviation of sqrt(0.02 * 0.98 / 2e5). It is off by
    # more than 4.42 deviations with probability 1e-5.
    assert abs(begun.mean() - 0.02) < 4.42 * math.sqrt(0.02 * 0.98 / 2e5)
    # Stalls of 0.1 to 0.3 s last 3.125 to 9.375 control steps. After rounding, the share of stalls
    # is 0.375 / 6.25 for 3 steps, 1 / 6.25 for each number from 4 to 8, and 0.875 / 6.25 for 9.
    counts = np.bincount(np.asarray(state.held)[begun] + 1, minlength=10)[3:]
    share = np.array([0.375, 1, 1, 1, 1, 1, 0.875]) / 6.25
    assert counts.sum() == begun.sum()
    deviation = np.sqrt(share * (1 - share) * counts.sum())
    assert (np.abs(counts - share * counts.sum()) < 4.42 * deviation).all(), counts  # as above


def test_after_a_stall_the_newest_command_that_is_due_counts() -> None:
    realism = RealismConfig(action_latency=(0, 2), stall=0.15, stall_time=(0.064, 0.064))
    latency = np.array([0, 1, 2], np.int32)
    arrived, _ = _run(realism, _numbered(40, 3), latency)
    late, _ = _run(LATE, _numbered(40, 3), latency)
    alone, _ = _run(RealismConfig(stall=0.15, stall_time=(0.064, 0.064)), _numbered(40, 3))
    fresh = alone[..., 0] == np.arange(1, 41)[:, None]  # where no stall runs
    assert 10 < (~fresh).sum() < 80
    # A stall acts on the command that is due, as if that command were sent in this step.
    expected = late[..., 0].copy()
    for t in range(40):
        before = expected[t - 1] if t else np.zeros(3)
        expected[t] = np.where(fresh[t], expected[t], before)
    np.testing.assert_array_equal(arrived[..., 0], expected)


def test_deliver_changes_nothing_that_it_was_given() -> None:
    realism = RealismConfig(action_latency=(0, 2), stall=0.5)
    state = motor.init(realism, 3, np)
    for clock, command in enumerate(_numbered(4, 3)):
        kept = jax.tree.map(np.copy, state)
        new, _ = motor.deliver(state, command, np.array([0, 1, 2]), realism, SEED, clock, STEP, np)
        jax.tree.map(np.testing.assert_array_equal, kept, state)
        state = new


# --- NumPy and JAX

REALISM = {
    "latency": LATE,
    "stall": RealismConfig(stall=0.2),
    "both": RealismConfig(stall=0.2, action_latency=(0, 2)),
}


@pytest.mark.parametrize("name", REALISM)
def test_numpy_with_leading_axes_and_mapped_jax_deliver_alike(name: str) -> None:
    realism, arenas, robots = REALISM[name], 6, 3
    random = np.random.default_rng(2)
    commands = random.normal(size=(25, arenas, robots, 2)).astype(np.float32)
    latency = random.integers(0, 3, (arenas, robots), dtype=np.int32)
    seeds = np.arange(arenas, dtype=np.uint32)

    def arena(state: Motor, command: Any, late: Any, seed: Any, clock: Any) -> Any:
        return motor.deliver(state, command, late, realism, seed, clock, STEP, jnp)

    step = jax.jit(jax.vmap(arena, in_axes=(0, 0, 0, 0, None)))
    first = motor.init(realism, robots, np)
    ours = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (arenas, *leaf.shape)), first)
    theirs, waited = ours, False
    for clock, command in enumerate(commands):
        ours, expected = motor.deliver(ours, command, latency, realism, seeds, clock, STEP, np)
        theirs, found = step(theirs, command, latency, seeds, jnp.int32(clock))
        np.testing.assert_array_equal(found, expected)
        jax.tree.map(np.testing.assert_array_equal, theirs, ours)
        assert jax.tree.map(lambda leaf: leaf.dtype, theirs) == jax.tree.map(
            lambda leaf: leaf.dtype, first
        )
        waited = waited or bool((expected != command).any())
    assert waited  # otherwise no command was late


@pytest.mark.parametrize("version", ["epuck1", "epuck2", None])
@pytest.mark.parametrize("deviation", [0.05, None])
def test_numpy_with_leading_axes_and_mapped_jax_disturb_alike(
    version: Any, deviation: float | None
) -> None:
    realism = RealismConfig(speed_noise=deviation, speed_quantisation=version)
    seeds = np.arange(20, dtype=np.uint32)
    wheels = np.random.default_rng(3).uniform(-7, 7, (20, 5, 2)).astype(np.float32)

    def arena(wheel: Any, seed: Any, clock: Any) -> Any:
        return motor.disturb(wheel, realism, seed, clock, jnp)

    expected = motor.disturb(wheels, realism, seeds, 4, np)
    found = jax.jit(jax.vmap(arena, in_axes=(0, 0, None)))(wheels, seeds, jnp.int32(4))
    assert found.dtype == expected.dtype == np.float32
    # 5e-6 rad/s covers the normal numbers' error of 2e-6 times 0.05, and 10 ulp of a float32 at 8.
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-6)


# --- wheels


@pytest.mark.parametrize(
    ("version", "asked", "made"),
    [
        # Version 1 makes 10000 / int(10000 / s) steps per second. A step here takes 10, 11, 12 or
        # 16 ticks of 0.1 ms (`e_motors.c` of e-puck-library).
        ("epuck1", 1000, 1000.0),
        ("epuck1", 950, 1000.0),
        ("epuck1", 900, 909.0909),
        ("epuck1", 800, 833.3333),
        ("epuck1", 600, 625.0),
        # Version 2 makes 100000 / (2 int(100000 / (2 s))) steps per second. The integer here is 50,
        # 52, 83, 45 or 50000.
        ("epuck2", 1000, 1000.0),
        ("epuck2", 950, 961.5385),
        ("epuck2", 600, 602.4096),
        ("epuck2", 1100, 1111.1111),
        ("epuck2", 1, 1.0),
        # A fraction of a step per second is cut off, so 0.98 steps per second become 0.
        ("epuck1", 909.9, 909.0909),
        ("epuck2", 1.98, 1.0),
        ("epuck1", 0.98, 0.0),
        ("epuck2", 0.98, 0.0),
        ("epuck1", 0, 0.0),
        # No timer is faster than its tick.
        ("epuck1", 1e12, 10_000.0),
        ("epuck2", 1e12, 50_000.0),
    ],
)
def test_speeds_of_the_firmware(version: Any, asked: float, made: float) -> None:
    # A thousandth of a step per second keeps whole numbers from being rounded down by one.
    speed = np.array([asked + 1e-3, -asked - 1e-3]) * RATE
    for xp, kind in ((np, np.float64), (np, np.float32), (jnp, np.float32)):
        found = motor.quantise(xp.asarray(speed, kind), version, xp)
        assert found.dtype == kind
        # 5e-7 covers half of the table's last digit and three roundings of float32.
        np.testing.assert_allclose(np.asarray(found) / RATE, [made, -made], rtol=5e-7)


@given(st.sampled_from(["epuck1", "epuck2"]), st.floats(-8.0, 8.0, width=32, allow_subnormal=False))
def test_the_wheel_makes_the_next_faster_speed_that_the_timer_has(
    version: Any, speed: float
) -> None:
    found = float(motor.quantise(np.array([speed], np.float32), version, np)[0])
    asked, made = abs(speed) / RATE, abs(found) / RATE
    if asked < 1.0 - 1e-6:
        assert found == 0.0
    if asked < 1.0 + 1e-6:
        return
    assert math.copysign(1.0, found) == math.copysign(1.0, speed)
    # The firmware cuts off less than one step per second and less than one tick. 1e-6 is the
    # rounding of float32.
    ticks = {"epuck1": 10_000, "epuck2": 50_000}[version]
    assert made * (1 + 1e-6) >= asked - 1.0
    assert ticks / made * (1 + 1e-6) > ticks / asked - 1.0
    assert ticks / made == pytest.approx(round(ticks / made), rel=1e-6)


def test_speed_noise_is_relative_and_each_wheels_own() -> None:
    realism = RealismConfig(speed_noise=0.05)
    wheels = np.full((50_000, 1, 2), -4.0, np.float32)
    found = motor.disturb(wheels, realism, np.arange(50_000, dtype=np.uint32), 7, np)
    relative = (found / wheels - 1.0).astype(float)[:, 0]
    # The mean, the standard deviation and the correlation are each off by more than 4.42 of their
    # deviations with probability 1e-5.
    assert np.abs(relative.mean(axis=0)).max() < 4.42 * 0.05 / math.sqrt(50_000)
    assert np.abs(relative.std(axis=0) - 0.05).max() < 4.42 * 0.05 / math.sqrt(2 * 50_000)
    assert abs(np.corrcoef(relative.T)[0, 1]) < 4.42 / math.sqrt(50_000)
    # Each control step draws new noise.
    later = motor.disturb(wheels, realism, np.arange(50_000, dtype=np.uint32), 8, np)
    both = np.stack([found[:, 0, 0], later[:, 0, 0]])
    assert abs(np.corrcoef(both)[0, 1]) < 4.42 / math.sqrt(50_000)


def test_the_noise_comes_on_top_of_what_the_firmware_makes() -> None:
    realism = RealismConfig(speed_noise=0.05, speed_quantisation="epuck1")
    wheels = np.full((4, 2), 950.5 * RATE)  # the firmware makes it 1000 steps per second
    noisy = motor.disturb(wheels, realism, SEED, 0, np)
    drawn = noise.normal(SEED, 0, Stream.SPEED_NOISE, (4, 2), np)
    # 1e-6 covers the rounding of float32 at 6.3 rad/s.
    np.testing.assert_allclose(noisy, 1000 * RATE * (1 + 0.05 * drawn), rtol=1e-6)


def test_wheels_at_rest_stay_at_rest() -> None:
    realism = RealismConfig(speed_noise=0.5, speed_quantisation="epuck2")
    np.testing.assert_array_equal(motor.disturb(np.zeros((3, 2)), realism, SEED, 0, np), 0.0)


def test_ideal_wheels_do_as_they_are_told() -> None:
    wheels = np.random.default_rng(0).normal(size=(3, 2))
    assert motor.disturb(wheels, IDEAL, SEED, 0, np) is wheels
