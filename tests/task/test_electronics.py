"""Tests the paths from command to wheels and from sensors to policy, by hand-computed values."""

import math
from types import ModuleType
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from entries import BEARING, DISTANCE, INFRARED, KNOWN, TARGET

from swarmjax.run.load_settings import load_train
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import noise
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import electronics as task_electronics
from swarmjax.task import factors as task_factors
from swarmjax.task import observation
from swarmjax.task.config import TaskConfig
from swarmjax.task.electronics import Electronics, Memory, Sight
from swarmjax.task.factors import Factors

# One text computes both. JAX compiles each shape anew, so only the comparisons below take it.
MODULES = pytest.mark.parametrize(
    "xp", [np, pytest.param(jnp, marks=pytest.mark.slow)], ids=["numpy", "jax"]
)
ENCODINGS = pytest.mark.parametrize("encoding", ["metric", "webots"])
RESPONSES = pytest.mark.parametrize("kind", ["ideal", "webots", "real"])
Encoding = Literal["metric", "webots"]
Kind = Literal["ideal", "webots", "real"]
ARENAS, ROBOTS, SENSORS = 2, 3, 8
STEP, RANGE, RISE = 0.032, 0.04, math.cos(0.16)  # s; m; horizontal part of a ray of 1 m
MOTORS = sim_drive.from_config(RobotConfig())
SEED = np.array([11, 12], np.uint32)  # one seed per arena
RATE = 2 * math.pi / 1000  # rad/s at one step of the motor per second
# Float32 rounds counts of up to 4095 / 1023 by 2.4e-7, and distances by 4e-9 m. Where the table is
# steepest, 380 / m, these 4e-9 m add 1.5e-6.
ROUNDING = 2e-6
FREE = 67.19  # counts of Webots' sensor when it sees nothing


def _electronics(encoding: Encoding | None = None, **realism: Any) -> Electronics:
    return task_electronics.load(TaskConfig(), RealismConfig(**realism), encoding)


def _factors(xp: ModuleType, **fields: Any) -> Factors:
    """Returns the factors of all arenas, with each given value broadcast to them."""
    shapes = {"infrared_period": (ROBOTS,), "observation_latency": (ROBOTS,), "seed": ()}
    shapes |= {"action_latency": (ROBOTS,), "max_wheel_speed": (ROBOTS,)}
    full = {}
    for name, value in fields.items():
        kind = np.asarray(value).dtype
        kind = np.float32 if kind == np.float64 else kind
        shape = (ARENAS, *shapes.get(name, (ROBOTS, SENSORS)))
        full[name] = xp.asarray(np.broadcast_to(np.asarray(value, kind), shape))
    return Factors(**full)


def _sight(
    xp: ModuleType,
    ray: Any = 1.0,
    distance: Any = 0.3,
    bearing: Any = math.pi / 2,
    reflectance: Any = None,
    arenas: int = ARENAS,
) -> Sight:
    """Returns what the robots of all arenas see, with each given value broadcast to them."""

    def full(value: Any, *axes: int) -> Any:
        return xp.asarray(np.broadcast_to(np.float32(value), (arenas, ROBOTS, *axes)))

    bright = None if reflectance is None else full(reflectance, SENSORS)
    return Sight(full(ray, SENSORS), bright, full(distance), full(bearing))


def _clock(xp: ModuleType, clock: int) -> Any:
    """Returns the clock as the judge keeps it: one count for each arena."""
    return xp.full(ARENAS, clock)


def _first(electronics: Electronics, found: Factors, sight: Sight, xp: ModuleType) -> np.ndarray:
    """Returns the first observation, [A, R, O]."""
    return np.asarray(task_electronics.begin(electronics, found, sight, _clock(xp, 0), xp)[1])


# --- values that are the same for every episode


@pytest.mark.parametrize(
    ("kind", "encoding", "sensor_range", "expected"),
    [
        ("ideal", "metric", 0.04, 0.04),
        ("ideal", "webots", 0.04, 0.07 * RISE),  # the end of Webots' table, projected to the floor
        ("webots", "metric", 0.04, 0.07 * RISE),
        ("webots", "webots", 0.04, 0.07 * RISE),
        ("real", "metric", 0.04, 0.10),
        ("real", "webots", 0.04, 0.10),
        ("ideal", "metric", 0.5, 0.5),
        ("real", "metric", 0.5, 0.5),
    ],
)
def test_reach(kind: Kind, encoding: Encoding, sensor_range: float, expected: float) -> None:
    robot, realism = RobotConfig(sensor_range=sensor_range), RealismConfig(infrared=kind)
    found = task_electronics.load(TaskConfig(), realism, encoding, robot=robot)
    assert found.reach == expected


def test_a_policy_observes_what_it_was_trained_to() -> None:
    assert _electronics(infrared="webots").encoding == "webots"
    assert _electronics(infrared="real").encoding == "metric"
    assert _electronics("metric", infrared="webots").encoding == "metric"
    task = TaskConfig(encoding="webots", control_step=0.02)
    found = task_electronics.load(task, RealismConfig())
    assert (found.encoding, found.control_step) == ("webots", 0.02)


@MODULES
def test_reflectance_is_there_if_any_part_of_it_is(xp: ModuleType) -> None:
    assert task_electronics.reflectance(Factors(mass=xp.ones((ARENAS, ROBOTS)))) is None
    fixture, robot = xp.ones((2, 5)), xp.ones((2, 3))
    for name, part, shade in (
        ("reflectance", "fixture", fixture),
        ("reflectance_robot", "robot", robot),
    ):
        found = task_electronics.reflectance(Factors(**{name: shade}))
        assert found is not None
        assert [each is shade for each in found] == [each == part for each in found._fields]


# --- all factors off


@MODULES
@ENCODINGS
def test_with_all_factors_off_nothing_is_touched(xp: ModuleType, encoding: Encoding) -> None:
    electronics, off = _electronics(encoding), Factors()
    ray = np.random.default_rng(0).uniform(0.0, 0.069, (ARENAS, ROBOTS, SENSORS))
    sight = _sight(xp, ray, 0.7, -3.0)
    memory, seen = task_electronics.begin(electronics, off, sight, _clock(xp, 0), xp)
    assert memory == Memory(None, None, None)
    command = xp.asarray(np.random.default_rng(1).uniform(-3, 3, (ARENAS, ROBOTS, 2)))
    memory, wheels = task_electronics.drive(
        electronics, memory, off, command, MOTORS, _clock(xp, 0), xp
    )
    assert memory == Memory(None, None, None)
    memory, again = task_electronics.sense(electronics, memory, off, sight, _clock(xp, 1), xp)
    assert memory == Memory(None, None, None)
    np.testing.assert_array_equal(wheels, sim_drive.wheel_speeds(command, MOTORS, xp))
    np.testing.assert_array_equal(seen, again)
    assert seen.dtype == np.float32
    if encoding == "metric":
        expected = np.minimum(np.float32(ray), np.float32(0.04))
        np.testing.assert_array_equal(seen[..., INFRARED], expected)
        np.testing.assert_array_equal(seen[..., DISTANCE], np.float32(0.7))
        np.testing.assert_array_equal(seen[..., BEARING], np.float32(-3.0))


# --- observed values

# Every sensor except ps0 has an object of reflectance 0.5 at 12 mm. Of these sensors, ps2 and ps5
# look straight out through 6 mm of the robot, so that their gap to the object is 6 mm.
#   Webots' table: the ray is 0.012 / cos 0.16 = 0.0121553 m long, which gives
#   1465.73 - 172854 * 0.0021553 = 1093.19 counts. The reflectance makes it act as 0.0243105 m,
#   which gives 383.84 - 14891 * 0.0043105 = 319.65 counts, like a ray of 0.024 m to a fully
#   reflecting object.
#   The measured curve: 0.5 A / (gap + d)^2 equals A / (sqrt 2 (gap + d))^2. The sensor thus reports
#   a fully reflecting object at sqrt 2 (gap + d) - d + 0.006: 0.0155736 m for ps2 and 0.0161450 m
#   for ps5. In Webots' table these are 0.0157751 and 0.0163539 m, which give
#   601.46 - 43524 * 0.0007751 = 567.72 counts and 542.53 counts.
PS2, PS5, NOTHING = 2, 5, 0
OBSERVED = {
    ("ideal", "metric"): (0.012, 0.012, 0.04),
    ("ideal", "webots"): (1093.19 / 1023, 1093.19 / 1023, FREE / 1023),
    ("webots", "metric"): (0.024, 0.024, 0.04),
    ("webots", "webots"): (319.652 / 1023, 319.652 / 1023, FREE / 1023),
    ("real", "metric"): (0.0155736, 0.0161450, 0.04),
    ("real", "webots"): (567.72 / 1023, 542.53 / 1023, FREE / 1023),
}


@MODULES
@RESPONSES
@ENCODINGS
def test_what_is_observed_of_a_thing_nearby(xp: ModuleType, kind: Kind, encoding: Encoding) -> None:
    ray, bright = np.full(SENSORS, 0.012), np.full(SENSORS, 0.5)
    ray[NOTHING], bright[NOTHING] = 1.0, 1.0
    electronics = _electronics(encoding, infrared=kind)
    seen = _first(electronics, Factors(), _sight(xp, ray, reflectance=bright), xp)
    assert seen.shape == (ARENAS, ROBOTS, observation.SIZE)
    assert seen.dtype == np.float32
    ps2, ps5, nothing = OBSERVED[kind, encoding]
    # The expected values above are rounded: counts to 5e-3, lengths to 5e-8 m.
    rounding = 5e-3 / 1023 + ROUNDING if encoding == "webots" else 1e-7
    for sensor, expected in ((PS2, ps2), (PS5, ps5), (NOTHING, nothing)):
        found = seen[..., INFRARED][..., sensor]
        np.testing.assert_allclose(found, expected, rtol=0, atol=rounding)
    # The target is 0.3 m away, a quarter turn to the left.
    target = (0.3, math.pi / 2) if encoding == "metric" else (0.3 / 1.5, 0.75)
    np.testing.assert_allclose(seen[..., TARGET], np.broadcast_to(target, (ARENAS, ROBOTS, 2)))


@MODULES
@RESPONSES
@ENCODINGS
def test_a_dead_sensor_sees_nothing(xp: ModuleType, kind: Kind, encoding: Encoding) -> None:
    dead = np.zeros((ARENAS, ROBOTS, SENSORS), bool)
    dead[1, 2, PS5] = True
    electronics, sight = _electronics(encoding, infrared=kind), _sight(xp, 0.012)
    sound = _first(electronics, Factors(), sight, xp)
    seen = _first(electronics, _factors(xp, dead_sensor=dead), sight, xp).copy()
    nothing = 0.04 if encoding == "metric" else FREE / 1023
    entry = (1, 2, INFRARED.start + PS5)
    np.testing.assert_allclose(seen[entry], nothing, rtol=1e-6)  # float32
    assert sound[entry] != seen[entry]
    seen[entry] = sound[entry]
    np.testing.assert_array_equal(seen[..., KNOWN], sound[..., KNOWN])


@MODULES
def test_wear_of_the_sensors(xp: ModuleType) -> None:
    gain = np.linspace(0.7, 1.3, ARENAS * ROBOTS * SENSORS).reshape(ARENAS, ROBOTS, SENSORS)
    electronics = _electronics("webots", infrared="webots")
    # The ray is 0.0243105 m long in the table, as above. 67.19 counts are not reflected light.
    sight = _sight(xp, 0.024)
    seen = _first(electronics, _factors(xp, infrared_gain=gain), sight, xp)
    expected = (FREE + gain * (319.652 - FREE)) / 1023
    np.testing.assert_allclose(seen[..., INFRARED], expected, rtol=0, atol=ROUNDING)


@MODULES
def test_noise_of_the_sensors_is_drawn_at_every_control_step(xp: ModuleType) -> None:
    electronics = _electronics("webots", infrared="webots")
    worn = _factors(xp, seed=SEED, infrared_noise=2.0)
    sight, clock = _sight(xp), _clock(xp, 0)
    memory, seen = task_electronics.begin(electronics, worn, sight, clock, xp)
    _, later = task_electronics.sense(electronics, memory, worn, sight, clock + 7, xp)
    for now, found in ((0, seen), (7, later)):
        drawn = noise.normal(SEED, np.array(now), Stream.INFRARED, (ROBOTS, SENSORS), np)
        # In free space, the deviation is 0.04897 of the counts; `infrared_noise` doubles it here.
        expected = FREE * (1.0 + 2 * 0.04897 * drawn) / 1023
        # The relative tolerance covers float32 and the rounding of log and cos.
        np.testing.assert_allclose(found[..., INFRARED], expected, rtol=2e-6)


# --- the sensors' period

# Control step n ends at 32 n ms. Samples are taken at the multiples of the period. With a period of
# 50 ms, the sample at 50 ms falls into step 2, 100 into 4, 150 into 5, 200 into 7, 250 into 8, 300
# into 10, 350 into 11, 400 into 13, 450 into 15 and 500 into 16 (480 to 512 ms).
DUE_50 = [2, 4, 5, 7, 8, 10, 11, 13, 15, 16]
STEPS = 16


@MODULES
@ENCODINGS
def test_a_sample_is_held_until_the_next(xp: ModuleType, encoding: Encoding) -> None:
    electronics = _electronics(encoding, infrared_period=(0.01, 0.05))
    # In each arena, robot 0 samples slowly, robot 1 fast, and robot 2 once per control step.
    slow = _factors(xp, infrared_period=[0.05, 0.01, 0.032])
    rays = 0.001 * np.arange(STEPS + 1) + 0.01
    fresh = [_first(electronics, Factors(), _sight(xp, ray), xp)[0, 0, INFRARED][3] for ray in rays]
    memory, seen = task_electronics.begin(electronics, slow, _sight(xp, rays[0]), _clock(xp, 0), xp)
    found, bearing = [seen], [0.1 * n for n in range(STEPS + 1)]
    for n in range(1, STEPS + 1):
        sight = _sight(xp, rays[n], bearing=bearing[n])
        memory, seen = task_electronics.sense(electronics, memory, slow, sight, _clock(xp, n), xp)
        found.append(seen)
    ray = np.stack(found)[..., INFRARED]  # [T, A, R, K]
    last = [max([m for m in DUE_50 if m <= n], default=0) for n in range(STEPS + 1)]
    held = np.array([fresh[n] for n in last])[:, None, None]
    np.testing.assert_array_equal(ray[:, :, 0], np.broadcast_to(held, (STEPS + 1, ARENAS, SENSORS)))
    at_once = np.array(fresh)[:, None, None, None]
    np.testing.assert_array_equal(ray[:, :, 1:], np.broadcast_to(at_once, ray[:, :, 1:].shape))
    # The target does not come from the infrared sensors, so it waits for no sample.
    turned = np.array(bearing[1:])
    turned = turned if encoding == "metric" else (turned + math.pi) / (2 * math.pi)
    found = np.stack(found)[1:, :, 0, BEARING]
    np.testing.assert_allclose(found, np.stack([turned] * ARENAS, axis=-1), rtol=1e-6)  # float32


def _due(clock: Any, period: Any, xp: Any) -> Any:
    """Returns whether robots sample, [A, R], in control steps [A], inferred from observations."""
    count, robots = period.shape
    electronics = _electronics(infrared_period=(0.01, 0.05))
    none = xp.zeros((count, robots, SENSORS), xp.float32)
    sight = Sight(none + 0.02, None, none[..., 0], none[..., 0])
    found, memory = Factors(infrared_period=period), Memory(None, none, None)
    _, seen = task_electronics.sense(electronics, memory, found, sight, clock, xp)
    return seen[..., INFRARED.start] > 0.0


@MODULES
@pytest.mark.parametrize("share", [0.25, 0.5, 1.0, 2.0, 5.0])
def test_a_period_in_step_with_the_control_never_slips(xp: ModuleType, share: float) -> None:
    # An episode of Table 1 has 1500 control steps. If the period is a multiple of the step, a
    # sample is due once a period. If it is a fraction of the step, one is due at every step.
    clock = np.arange(1, 1501, dtype=np.int32)
    due = _due(xp.asarray(clock), xp.full((len(clock), 1), share * STEP, xp.float32), xp)
    np.testing.assert_array_equal(due[:, 0], clock % max(share, 1.0) == 0)


def test_numpy_and_jax_sample_in_the_same_control_steps() -> None:
    period = np.random.default_rng(0).uniform(0.01, 0.05, (1, 20_000)).astype(np.float32)
    due = jax.jit(lambda clock, period: _due(clock, period, jnp))
    for n in range(100, 1500, 50):
        mine = _due(np.array([n]), period, np)
        np.testing.assert_array_equal(due(jnp.array([n]), period), mine)
        assert mine[period <= np.float32(STEP)].all()
        # With a period of 50 ms, a sample falls into 0.64 of the steps. The mean over periods of 32
        # to 50 ms is 0.032 log(50 / 32) / 0.018 = 0.793. The bound is five standard errors.
        slow = mine[period > np.float32(STEP)]
        assert abs(slow.mean() - 0.793) < 5 * math.sqrt(0.793 * 0.207 / len(slow))


# --- delayed observations


@MODULES
def test_an_observation_arrives_after_its_latency(xp: ModuleType) -> None:
    electronics = _electronics(observation_latency=(0, 2))
    late = np.array([[0, 1, 2], [2, 2, 0]], np.int32)
    found = _factors(xp, observation_latency=late)
    memory, seen = task_electronics.begin(
        electronics, found, _sight(xp, distance=1.0), _clock(xp, 0), xp
    )
    np.testing.assert_array_equal(seen[..., DISTANCE], 1.0)
    assert memory.seen is not None
    assert memory.seen.shape == (ARENAS, 2, ROBOTS, observation.SIZE)
    arrived = []
    for n in range(1, 6):
        sight = _sight(xp, distance=1.0 + n)
        memory, seen = task_electronics.sense(electronics, memory, found, sight, _clock(xp, n), xp)
        assert seen.shape == (ARENAS, ROBOTS, observation.SIZE)
        arrived.append(np.asarray(seen[..., DISTANCE]))
    # The distances are 1, 2, .. 6. Robots observe distance 1 until a later one arrives.
    at_once, next_, second = [2, 3, 4, 5, 6], [1, 2, 3, 4, 5], [1, 1, 2, 3, 4]
    expected = [[at_once, next_, second], [second, second, at_once]]
    np.testing.assert_array_equal(np.moveaxis(arrived, 0, -1), expected)
    assert memory.seen is not None
    kept = memory.seen[..., DISTANCE]
    np.testing.assert_array_equal(kept, np.full((ARENAS, 2, ROBOTS), [[6], [5]]))


@MODULES
def test_a_latency_of_zero_keeps_nothing(xp: ModuleType) -> None:
    electronics = _electronics(observation_latency=(0, 0), action_latency=(0, 0))
    none = np.zeros(ROBOTS, np.int32)
    found = _factors(xp, observation_latency=none, action_latency=none)
    memory, _ = task_electronics.begin(electronics, found, _sight(xp), _clock(xp, 0), xp)
    assert memory == Memory(None, None, None)
    _, seen = task_electronics.sense(
        electronics, memory, found, _sight(xp, distance=2.0), _clock(xp, 1), xp
    )
    np.testing.assert_array_equal(seen[..., DISTANCE], 2.0)


@MODULES
def test_a_late_sample_is_both_held_and_late(xp: ModuleType) -> None:
    """Samples at every second control step; the policy observes each sample one step later."""
    electronics = _electronics(observation_latency=(1, 1), infrared_period=(0.064, 0.064))
    found = _factors(xp, observation_latency=np.int32(1), infrared_period=0.064)
    memory, _ = task_electronics.begin(electronics, found, _sight(xp, 0.010), _clock(xp, 0), xp)
    arrived = []
    for n in range(1, 7):
        sight = _sight(xp, 0.010 + 0.001 * n)
        memory, seen = task_electronics.sense(electronics, memory, found, sight, _clock(xp, n), xp)
        arrived.append(round(1000 * float(seen[1, 2, INFRARED][3])))
    # The sensor samples in steps 0, 2, 4 and 6.
    assert arrived == [10, 10, 12, 12, 14, 14]


# --- the target

MANY = 20_000


def _targets(xp: ModuleType, distance: float, bearing: float, **realism: Any) -> np.ndarray:
    """Returns the observed distance and bearing of one target for MANY seeds, [MANY, R, 2]."""
    found = Factors(seed=xp.arange(MANY, dtype=xp.uint32))
    sight = _sight(xp, 1.0, distance, bearing, arenas=MANY)
    clock = xp.zeros(MANY, xp.int32)
    _, seen = task_electronics.begin(_electronics(**realism), found, sight, clock, xp)
    return np.asarray(seen)[..., TARGET]


@MODULES
def test_noise_of_the_target(xp: ModuleType) -> None:
    far, angle = 0.005, 0.0524
    seen = _targets(xp, 0.5, 1.0, target_distance_noise=far, target_bearing_noise=angle)
    # Five standard errors: sd / sqrt(n) and sd / sqrt(2 n). The seeds are fixed.
    for i, (mean, sd) in enumerate(((0.5, far), (1.0, angle))):
        drawn = seen[..., i].astype(float)
        assert (abs(drawn.mean(axis=0) - mean) < 5 * sd / math.sqrt(MANY)).all()
        assert (abs(drawn.std(axis=0) - sd) < 5 * sd / math.sqrt(2 * MANY)).all()
    # Noise is uncorrelated between robots, and between distance and bearing.
    shared = np.corrcoef(seen.reshape(MANY, -1).T) - np.eye(2 * ROBOTS)
    assert abs(shared).max() < 5 / math.sqrt(MANY)


@MODULES
def test_noise_of_the_target_is_drawn_at_every_control_step(xp: ModuleType) -> None:
    electronics = _electronics(target_distance_noise=0.01)
    found, sight = _factors(xp, seed=SEED), _sight(xp)
    memory, _ = task_electronics.begin(electronics, found, sight, _clock(xp, 0), xp)
    _, seen = task_electronics.sense(electronics, memory, found, sight, _clock(xp, 9), xp)
    drawn = noise.normal(SEED, np.array(9), Stream.TARGET_DISTANCE, (ROBOTS,), np)
    # The tolerance covers float32 and the rounding of log and cos.
    np.testing.assert_allclose(seen[..., DISTANCE], 0.3 + 0.01 * drawn, rtol=1e-6)
    np.testing.assert_array_equal(seen[..., BEARING], np.float32(math.pi / 2))


@MODULES
def test_a_bearing_stays_an_angle(xp: ModuleType) -> None:
    seen = _targets(xp, 0.5, math.pi, target_bearing_noise=0.5)[..., 1].astype(float)
    assert abs(seen).max() <= np.float32(math.pi)
    assert 0.45 < (seen < 0.0).mean() < 0.55  # half of the readings wrap around pi
    beyond = seen % (2 * math.pi) - math.pi
    # The bound is five standard errors of the sd.
    assert abs(beyond.std() - 0.5) < 5 * 0.5 / math.sqrt(2 * MANY * ROBOTS)
    np.testing.assert_array_equal(_targets(xp, 0.5, 1.0)[..., 1], np.float32(1.0))


@MODULES
def test_a_distance_is_never_negative(xp: ModuleType) -> None:
    seen = _targets(xp, 0.002, 0.0, target_distance_noise=0.004)[..., 0]
    assert seen.min() == 0.0
    # Of a normal distribution, 30.85 % lie more than half a deviation below the mean. The bound is
    # five standard errors.
    spread = math.sqrt(0.3085 * 0.6915 / (MANY * ROBOTS))
    assert abs((seen == 0.0).mean() - 0.3085) < 5 * spread


# --- commands


def _wheels(
    xp: ModuleType, found: Factors, commands: list[Any], **realism: Any
) -> tuple[np.ndarray, Memory]:
    """Sends commands to all robots; returns wheel speeds [T, A, R, 2] and the last memory."""
    electronics = _electronics(**realism)
    memory, _ = task_electronics.begin(electronics, found, _sight(xp), _clock(xp, 0), xp)
    driven = []
    for n, command in enumerate(commands):
        every = xp.asarray(np.broadcast_to(np.float32(command), (ARENAS, ROBOTS, 2)))
        clock = _clock(xp, n)
        memory, wheels = task_electronics.drive(
            electronics, memory, found, every, MOTORS, clock, xp
        )
        driven.append(np.asarray(wheels))
    return np.stack(driven), memory


@MODULES
def test_a_command_is_late(xp: ModuleType) -> None:
    late = np.array([[0, 1, 2], [2, 0, 1]], np.int32)
    found = _factors(xp, action_latency=late)
    # At 0.02 m/s the wheels turn at 1 rad/s.
    commands = [(0.02 * n, 0.0) for n in range(1, 5)]
    wheels, memory = _wheels(xp, found, commands, action_latency=(0, 2))
    by_latency = np.array([[1, 2, 3, 4], [0, 1, 2, 3], [0, 0, 1, 2]])
    expected = np.stack([by_latency[late]] * 2, axis=-1)  # [A, R, T, 2]
    np.testing.assert_allclose(np.moveaxis(wheels, 0, 2), expected, rtol=1e-6)  # float32
    assert memory.commands is not None
    assert memory.commands.shape == (ARENAS, 2, ROBOTS, 2)


@MODULES
def test_each_robot_has_a_limit_of_its_own(xp: ModuleType) -> None:
    limit = np.array([[3.0, 6.0, 6.9], [5.0, 4.0, 2.0]])
    found = _factors(xp, max_wheel_speed=limit)
    # At 0.1 m/s and 1 rad/s the wheels turn at 5 +- 1.3 rad/s. The negated command reverses them.
    wheels, _ = _wheels(xp, found, [(0.1, 1.0), (-0.1, -1.0)])
    ahead = np.stack([np.minimum(limit, 3.7), np.minimum(limit, 6.3)], axis=-1)
    np.testing.assert_allclose(wheels, [ahead, -ahead], rtol=1e-6)  # float32


@MODULES
def test_limit_then_quantisation_then_noise(xp: ModuleType) -> None:
    """Limits a wheel to 3 rad/s, which quantisation raises a little and noise then varies."""
    found = _factors(xp, max_wheel_speed=3.0, seed=SEED)
    clamped, _ = _wheels(xp, found, [(0.1, 0.0)], speed_quantisation="epuck2")
    # 3 rad/s are 477.46 steps/s. A step takes 50000 // 477 = 104 ticks, which gives 480.77 steps/s.
    np.testing.assert_allclose(clamped, 50000 / 104 * RATE, rtol=1e-6)  # float32
    both = {"speed_quantisation": "epuck2", "speed_noise": 0.05}
    wheels, _ = _wheels(xp, found, [(0.1, 0.0)] * 3, **both)
    for n in range(3):
        drawn = noise.normal(SEED, np.array(n), Stream.SPEED_NOISE, (ROBOTS, 2), np)
        expected = 50000 / 104 * RATE * (1.0 + 0.05 * drawn)
        np.testing.assert_allclose(wheels[n], expected, rtol=2e-6)  # float32, log and cos


# --- all factors together, as in training and in the judge


def _live(
    electronics: Electronics, memory: Memory | None, found: Factors, clock: Any, xp: Any
) -> tuple[Memory, Any]:
    """Runs a control step of robots that pass a wall; returns observations and wheel speeds."""
    nothing = xp.zeros((*clock.shape, ROBOTS), xp.float32)
    n = clock[..., None] + nothing
    ray = (0.025 + 0.01 * xp.sin(0.3 * n))[..., None] + xp.zeros(SENSORS, xp.float32)
    sight = Sight(ray, 0.0 * ray + 0.6, 0.5 - 0.01 * n, 0.2 * n)
    if memory is None:
        memory, seen = task_electronics.begin(electronics, found, sight, clock, xp)
    else:
        memory, seen = task_electronics.sense(electronics, memory, found, sight, clock, xp)
    command = xp.stack([nothing + 0.1, xp.sin(n)], axis=-1)
    memory, wheels = task_electronics.drive(electronics, memory, found, command, MOTORS, clock, xp)
    return memory, xp.concatenate([seen, wheels], axis=-1)


@ENCODINGS
def test_a_real_robot_is_the_same_in_numpy_and_jax(encoding: Encoding) -> None:
    """Compares arenas along a leading axis, as in the judge, with vmapped ones, as in training."""
    realism = load_train(["realism=real"]).realism
    electronics, seeds = (
        task_electronics.load(TaskConfig(), realism, encoding),
        np.arange(16, dtype=np.uint32),
    )
    found = task_factors.draw(seeds, realism, ROBOTS, 2, np)
    live = jax.jit(jax.vmap(lambda memory, found, n: _live(electronics, memory, found, n, jnp)))
    judged, trained, rows = None, None, []
    for n in range(40):
        clock = np.full(16, n, np.int32)
        judged, mine = _live(electronics, judged, found, clock, np)
        trained, theirs = live(trained, found, clock)
        # The tolerance covers float32, and the rounding of log and cos in the noise.
        np.testing.assert_allclose(theirs, mine, rtol=2e-6, atol=2e-6)
        rows.append(mine)
    jax.tree.map(
        lambda mine, theirs: np.testing.assert_equal(mine.shape, theirs.shape), judged, trained
    )
    rows = np.stack(rows)
    assert (rows[..., INFRARED] < rows[..., INFRARED].max()).mean() > 0.5  # most rays see something
    assert (rows[1:] != rows[:-1]).mean() > 0.5  # and most values change
