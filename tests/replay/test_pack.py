"""Tests that packed recordings are small and match what was recorded to within a quantum."""

import json
import zlib

import numpy as np
import pytest
import replays
import steering
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from swarmjax.replay import pack as replay_pack
from swarmjax.replay.record import Recording


def _unfold(planes: bytes, rows: int, columns: int, width: int) -> np.ndarray:
    """Decodes a series, written from the description of the format alone."""
    raw = np.frombuffer(planes, np.uint8).reshape(width, columns, rows).astype(np.int64)
    folded = np.einsum("w...,w->...", raw, 256 ** np.arange(width))
    steps = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
    return steps.cumsum(axis=1).T


def _unpack(packed: bytes) -> tuple[dict, list[dict[str, np.ndarray]]]:
    """Decodes the header and the series of all runs."""
    data = zlib.decompress(packed)
    size = int.from_bytes(data[:4], "little")
    header, at, runs = json.loads(data[4 : 4 + size]), 4 + size, []
    for episode in header["episodes"]:
        for run in episode["runs"]:
            runs.append({})
            for name, columns, width in run["series"]:
                end = at + run["frames"] * columns * width
                runs[-1][name] = _unfold(data[at:end], run["frames"], columns, width)
                at = end
    assert at == len(data)
    return header, runs


@given(
    arrays.arrays(
        np.int64,
        st.tuples(st.integers(1, 5), st.integers(1, 4)),
        elements=st.integers(-1 << 29, 1 << 29),
    )
)
def test_numbers_come_back(table):
    planes, width = replay_pack.fold(table)
    np.testing.assert_array_equal(_unfold(planes, len(table), table.shape[1], width), table)


def test_a_number_takes_no_more_bytes_than_it_needs():
    # A step n folds to 2 n, or to 2 |n| - 1 if n is below 0. 254 and 255 take one byte, and 256
    # takes two bytes.
    assert [replay_pack.fold(np.array([[n]]))[1] for n in (127, -128, 128)] == [1, 1, 2]


def _check(recording: Recording, series: dict[str, np.ndarray]) -> None:
    rows, robots = recording.pose.shape[:2]
    for name, i, quantum in (("x", 0, 2e-4), ("y", 1, 2e-4), ("yaw", 2, 1e-3)):
        # A coordinate is off by at most half a quantum, plus float64 rounding.
        error = np.abs(series[name] * quantum - recording.pose[..., i])
        assert error.max() <= 0.5 * quantum + 1e-12
    ray = series["ray"].reshape(rows, robots, 8)
    lit = recording.ray < 0.04
    np.testing.assert_array_equal(ray < 80, lit)  # 0.04 m / 0.5 mm
    assert (np.abs((ray + 0.5) * 5e-4 - recording.ray) <= 2.5e-4 + 1e-12)[lit].all()
    for name, term in recording.reward.items():
        error = np.abs(series[f"reward.{name}"] * 1e-4 - term.cumsum(axis=0))
        assert error.max() <= 0.5e-4 + 1e-12
    np.testing.assert_array_equal(series["touch"], recording.touching @ [1, 2, 4])
    np.testing.assert_array_equal(series["contacts"], recording.contacts.reshape(rows, -1))


def test_recordings_come_back_to_the_quantum(tmp_path):
    steer = steering.write(tmp_path / "steer.npz")
    words = [*replays.SMALL, "realism=real", "level=0,1", "steps=150"]
    _, found = replays.recorded(steer, *words)
    packed = replay_pack.pack(
        {"about": "it"}, [replays.episode(each, level=i) for i, each in enumerate(found)], 0.04
    )
    header, runs = _unpack(packed)
    assert header["about"] == "it"
    assert header["dark"] == 80
    assert [each["level"] for each in header["episodes"]] == [0, 1]
    for recording, series, episode in zip(found, runs, header["episodes"], strict=True):
        _check(recording, series)
        assert episode["runs"][0]["arrival"] == recording.arrival.tolist()
        # The header rounds to 1e-5.
        np.testing.assert_allclose(episode["target"], recording.target[0], atol=5.1e-6)
        np.testing.assert_allclose(episode["sensor"], recording.scene.sensor, atol=5.1e-6)


def test_large_swarms_have_coarser_quanta():
    for robots, coarser in ((100, 1), (101, 5)):
        one = replays.wandering(robots, 3)
        header, (series,) = _unpack(replay_pack.pack({}, [replays.episode(one)], 0.04))
        quanta = {"length": 2e-4 * coarser, "angle": 1e-3 * coarser, "reward": 1e-4 * coarser}
        assert header["quanta"] == pytest.approx(quanta | {"ray": 5e-4, "measure": 1e-3})
        error = np.abs(series["x"] * quanta["length"] - one.pose[..., 0])
        assert error.max() <= 0.5 * quanta["length"] + 1e-12


def test_sensors_that_are_all_alike_are_listed_once():
    header, _ = _unpack(replay_pack.pack({}, [replays.episode(replays.wandering(5, 3))], 0.04))
    assert np.shape(header["episodes"][0]["sensor"]) == (1, 8, 4)


def test_a_ray_just_below_its_range_is_lit():
    # The range is not a multiple of the quantum: 0.0402 / 0.0005 = 80.4.
    assert replay_pack.dark(0.0402) == 81
    recording = replays.wandering(1, 2)
    recording.ray[:] = [[[np.nextafter(0.0402, 0.0)] * 8], [[0.0402] * 8]]
    _, (series,) = _unpack(replay_pack.pack({}, [replays.episode(recording)], 0.0402))
    np.testing.assert_array_equal(series["ray"], [[80] * 8, [81] * 8])


def test_five_long_episodes_are_small_however_robots_move():
    # Base64 in the page turns 3 bytes into 4. Random motion compresses badly, real motion well.
    for robots, most in ((5, 1e6), (50, 2e6)):
        one = replays.wandering(robots, 1501)
        packed = replay_pack.pack({}, [replays.episode(one)], 0.04)
        assert 5 * len(packed) * 4 / 3 < most


def test_colours_are_told_apart():
    for count in (1, 10, 11, 100):
        found = replay_pack.colours(count)
        assert len(set(found)) == len(found) == count
        assert all(len(each) == 7 and int(each[1:], 16) >= 0 for each in found)
