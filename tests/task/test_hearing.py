"""Tests which robots hear each other, and how an observation holds it."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmjax.config import ConfigError
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import hearing, observation
from swarmjax.task.config import NeighboursConfig

XPS = [np, pytest.param(jnp, marks=pytest.mark.slow)]
NOBODY = np.array([[9.0, 9.0, 0.0, 0.1, 0.1]], np.float32)
# Robot 0 is in the middle and faces north. The others are 0.3 m north, 0.4 m east and 0.8 m west.
POSE = np.array([[0, 0, np.pi / 2], [0, 0.3, 0], [0.4, 0, 0], [-0.8, 0, 0]], np.float32)
PRESENT = np.ones(4, bool)


def _listen(
    xp: Any,
    pose: np.ndarray = POSE,
    obstacle: np.ndarray = NOBODY,
    present: np.ndarray = PRESENT,
    count: int = 2,
    seed: int | None = None,
    **realism: Any,
) -> np.ndarray:
    """Returns what each robot hears within 0.7 m, [R, K, W]."""
    config = NeighboursConfig(count=count)
    obstacle, pose = xp.asarray(obstacle, xp.float32), xp.asarray(pose)
    hidden = hearing.hidden(pose, obstacle, xp)
    heard = hearing.reachable(pose, xp.asarray(present), hidden, config, xp)
    drawn = None if seed is None else xp.asarray(seed, xp.uint32)
    found = hearing.listen(heard, config, RealismConfig(**realism), drawn, xp.asarray(3), xp)
    return np.asarray(found).reshape(len(pose), count, -1)


@pytest.mark.parametrize("xp", XPS)
def test_neighbours_are_nearest_first_in_the_frame_of_the_one_that_hears(xp: Any) -> None:
    # The robot in the north is straight ahead; the robot in the east is at -90 degrees.
    expected = [[1.0, 0.3, 1.0, 0.0], [1.0, 0.4, 0.0, -1.0]]
    np.testing.assert_allclose(_listen(xp)[0], expected, atol=1e-6)  # a sine in float32


@pytest.mark.parametrize("xp", XPS)
def test_one_out_of_range_hears_nobody(xp: Any) -> None:
    assert not _listen(xp)[3].any()


@pytest.mark.parametrize("xp", XPS)
def test_an_absent_robot_is_not_heard(xp: Any) -> None:
    found = _listen(xp, present=np.array([True, False, True, True]))[0]
    np.testing.assert_allclose(found[:, :2], [[1.0, 0.4], [0.0, 0.0]], atol=1e-7)


@pytest.mark.parametrize("xp", XPS)
def test_a_wall_in_between_hides_both_from_each_other(xp: Any) -> None:
    wall = np.array([[0.0, 0.15, 0.0, 0.05, 0.01]], np.float32)
    found = _listen(xp, obstacle=wall)
    np.testing.assert_allclose(found[0, :, 1], [0.4, 0.0], atol=1e-7)
    np.testing.assert_allclose(found[1, :, 1], [0.5, 0.0], atol=1e-7)  # only the robot in the east


@pytest.mark.parametrize("xp", XPS)
def test_a_wall_behind_hides_nobody(xp: Any) -> None:
    wall = np.array([[0.0, 0.4, 0.0, 0.05, 0.01]], np.float32)
    np.testing.assert_array_equal(_listen(xp, obstacle=wall), _listen(xp))


def test_more_neighbours_than_robots_are_rows_of_zeros() -> None:
    found = _listen(np, count=6)
    assert not found[:, 4:].any()
    np.testing.assert_array_equal(found[:, :2], _listen(np))


@pytest.mark.parametrize("xp", XPS)
def test_packets_are_lost_as_often_as_said(xp: Any) -> None:
    pose = np.zeros((40, 3), np.float32)
    pose[:, 0] = 0.01 * np.arange(40)
    whom = {"pose": pose, "present": np.ones(40, bool)}
    found = _listen(xp, count=32, seed=1, packet_loss=0.75, **whom)
    heard = found[..., 0].sum() / (40 * 39)
    assert abs(heard - 0.25) < 0.044  # 4 standard errors, from 1,560 packets


def test_a_lost_packet_leaves_no_trace() -> None:
    assert not _listen(np, seed=1, packet_loss=1.0).any()


def test_noise_of_a_pair_does_not_depend_on_how_many_robots_there_are() -> None:
    noisy = {"seed": 5, "packet_loss": 0.5}
    whole = _listen(np, **noisy)
    fewer = _listen(np, pose=POSE[:3], present=PRESENT[:3], **noisy)
    np.testing.assert_array_equal(fewer, whole[:3])
    assert not np.allclose(whole[0], _listen(np)[0])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 5))
def test_numpy_and_jax_hear_the_same(seed: int, count: int) -> None:
    draw = np.random.default_rng(seed)
    pose = draw.uniform(-0.6, 0.6, (5, 3)).astype(np.float32)
    boxes = np.concatenate([draw.uniform(-0.6, 0.6, (3, 3)), draw.uniform(0.01, 0.1, (3, 2))], 1)
    whom: dict[str, Any] = {"pose": pose, "obstacle": boxes.astype(np.float32), "count": count}
    whom |= {"present": draw.random(5) < 0.8}
    found = [_listen(xp, seed=seed % 2**31, packet_loss=0.3, **whom) for xp in (np, jnp)]
    np.testing.assert_allclose(found[0], found[1], atol=2e-6)  # sine and square root in float32


def test_the_layout_names_what_is_heard() -> None:
    config = NeighboursConfig(count=2, range=0.5)
    found = observation.layout("metric", (), config)
    assert found.names[10:14] == (
        "neighbour_0",
        "neighbour_0_distance",
        "neighbour_0_bearing_cos",
        "neighbour_0_bearing_sin",
    )
    assert found.units[10:14] == ("1", "m", "1", "1")
    assert found.scale[10:14] == (1.0, 0.5, 1.0, 1.0)
    assert found.size == 10 + 2 * 4


def test_robots_that_do_not_hear_observe_as_before() -> None:
    assert observation.describe("metric", (), NeighboursConfig()) == observation.describe("metric")


@pytest.mark.parametrize(
    ("section", "said", "sentence"),
    [
        (NeighboursConfig, {"count": 1, "range": 0.0}, "range is 0"),
        (NeighboursConfig, {"count": 1, "range": 11.0}, "range is 11"),
        (NeighboursConfig, {"count": 33}, "count is 33"),
        (RealismConfig, {"packet_loss": 1.5}, "packet_loss is 1.5"),
    ],
)
def test_what_cannot_be_heard_is_refused(section: Any, said: Any, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        section(**said)
