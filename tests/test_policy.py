"""Tests policy.py, the one file that runs a policy: its results, and that it works alone."""

import ast
import dataclasses
import hashlib
import json
import os
import subprocess
import sys
import tracemalloc
import warnings
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import policies
import pytest
from entries import by_name
from policies import Arrays, saved, several

from swarmjax import epuck, policy, policy_file
from swarmjax.policy import Policy, PolicyError
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO, LearnerState
from swarmjax.sim import drive
from swarmjax.sim.config import RobotConfig
from swarmjax.task import observation

SIZE, ACTIONS = observation.SIZE, 2


def _f32(values: Any) -> np.ndarray:
    return np.array(values, np.float32)


def test_the_file_is_short_and_needs_numpy_alone(tmp_path: Path) -> None:
    source = Path(policy.__file__).read_text()
    assert len(source.splitlines()) <= 270  # three printed pages
    roots = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            roots |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            roots.add(str(node.module).partition(".")[0])
    assert roots - set(sys.stdlib_module_names) == {"numpy"}
    # A copy of the file runs without this project.
    (tmp_path / "policy.py").write_text(source)
    trained = saved(tmp_path / "policy.npz")
    code = (
        "import json, sys, numpy as np, policy\n"
        "trained = policy.load('policy.npz')\n"
        f"action = policy.act(trained, np.ones((2, {SIZE}), np.float32))\n"
        "assert 'swarmjax' not in sys.modules\n"
        "print(json.dumps(policy.command(trained, action).tolist()))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    ones = policy.act(trained, np.ones((2, SIZE), np.float32))
    assert json.loads(done.stdout) == policy.command(trained, ones).tolist()


def test_load_gives_what_the_file_holds(tmp_path: Path) -> None:
    arrays = policies.arrays(learners=2)
    saved(tmp_path / "policy.npz", arrays, **several(2))
    loaded = policy.load(tmp_path / "policy.npz")
    names = ("hidden_0", "hidden_1", "mean")
    for name, (kernel, bias) in zip(names, loaded.layers, strict=True):
        np.testing.assert_array_equal(kernel, arrays[f"actor/{name}/kernel"])
        np.testing.assert_array_equal(bias, arrays[f"actor/{name}/bias"])
    np.testing.assert_array_equal(loaded.log_std, arrays["actor/log_std"])
    np.testing.assert_array_equal(loaded.mean, arrays["normalizer/mean"])
    np.testing.assert_array_equal(loaded.std, arrays["normalizer/std"])
    assert (loaded.is_shared, loaded.encoding) == (False, "metric")
    assert (loaded.max_speed, loaded.max_turn_rate) == (epuck.MAX_SPEED, epuck.MAX_TURN_RATE)
    assert loaded.meta == policies.meta(**several(2)) | {"format": 5}


def test_the_digest_is_sha256_over_names_types_shapes_and_bytes() -> None:
    b = np.array([[1.0, 2.0]], np.float32)
    expected = hashlib.sha256()
    expected.update(b"a/x <f4 [1]\n" + _f32(3.0).tobytes())
    expected.update(b"b <f4 [1, 2]\n" + b.tobytes())
    expected.update(b"c <U2 []\n" + "no".encode("utf-32-le"))
    found = policy.digest({"b": b, "c": np.array("no"), "a/x": _f32([3.0])})
    assert found == expected.hexdigest()


def _claim(path: Path, size: int) -> None:
    """Makes the archive claim that its first member unpacks to `size` bytes."""
    content = bytearray(path.read_bytes())
    entry = content.index(b"PK\x01\x02")  # central directory; the size is 24 bytes further
    content[entry + 24 : entry + 28] = size.to_bytes(4, "little")
    path.write_bytes(content)


def _npy(dtype: str, shape: str) -> bytes:
    """Returns the header of an array without its data."""
    head = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({shape}), }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode()


def _member(path: Path, content: bytes) -> None:
    """Adds a member with this content."""
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("actor/hidden_9/bias.npy", content)


def _compress(path: Path) -> None:
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("actor/hidden_9/bias.npy", b"0")


def _double(path: Path) -> None:
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(path, "a") as archive:
        archive.writestr("meta.npy", archive.read("meta.npy"))


def _crowd(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        for i in range(2000):
            archive.writestr(f"{i}.npy", b"")


def _say(path: Path, text: str) -> None:
    policies.forge(path, policies.arrays(), text)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda path: path.unlink(), r"\[Errno 2\] No such file or directory"),
        (lambda path: path.write_bytes(path.read_bytes()[:900]), r"File is not a zip file"),
        (lambda path: path.write_bytes(b""), r"File is not a zip file"),
        (
            lambda path: policies.forge(path, policies.arrays(), {"format": 2}),
            r"meta\.format is 2, not 5",
        ),
        (
            lambda path: policies.forge(path, policies.arrays(), {"format": 5}, digest="0"),
            "its digest and its arrays do not match: it was changed or damaged",
        ),
        (lambda path: _claim(path, 2**30 + 1), "it unpacks to more than its size, or"),
        (_compress, "a member is compressed, encrypted, duplicated or no .npy file"),
        (_double, "a member is compressed, encrypted, duplicated or no .npy file"),
        (
            lambda path: _member(path, _npy("<f4", "2147483648,")),
            "'actor/hidden_9/bias.npy' does not match its header",
        ),
        (
            lambda path: _member(path, _npy("|O", "1,")),
            "'actor/hidden_9/bias.npy' does not match its header",
        ),
        (lambda path: _member(path, _npy("<U0", "1,")), ""),
        (
            lambda path: _member(path, b"\x93NUMPY\x02\x00"),
            "'actor/hidden_9/bias.npy' does not match its header",
        ),
        (_crowd, "its list of members has more than 65536 bytes"),
        (lambda path: _say(path, "[" * 100_000), "meta has more than 65536 entries"),
        (lambda path: _say(path, "[" * 60_000), "maximum recursion depth"),
        (lambda path: _say(path, "x" * 2**21), "meta is not a text of at most 1048576"),
        (lambda path: _say(path, '{"format": ' + "9" * 5000 + "}"), "Exceeds the limit"),
    ],
    ids=[
        *("missing", "truncated", "empty", "version", "digest", "bomb", "compressed", "doubled"),
        *("shape", "object", "no size", "npy version", "members", "entries", "depth", "text"),
        "digits",
    ],
)
def test_load_refuses_in_one_sentence(tmp_path: Path, damage: Any, sentence: str) -> None:
    path = tmp_path / "policy.npz"
    saved(path)
    damage(path)
    expected = rf"policy\.npz cannot be read as a policy: {sentence}[^\n]*\.$"
    with pytest.raises(PolicyError, match=expected):
        policy.load(path)


@pytest.mark.parametrize("path", ["a pipe", "/tmp"])
def test_load_waits_for_no_pipe(tmp_path: Path, path: str) -> None:
    os.mkfifo(tmp_path / "a pipe")
    with pytest.raises(
        PolicyError, match=r"cannot be read as a policy: it is not a regular file\.$"
    ):
        policy.load(tmp_path / path)


@pytest.mark.parametrize("read", [policy.load, policy_file.read])
@pytest.mark.parametrize("forge", ["shape", "bomb"])
def test_a_forged_file_takes_no_more_memory_than_four_times_its_size(
    tmp_path: Path, read: Any, forge: str
) -> None:
    path = tmp_path / "policy.npz"
    saved(path)
    if forge == "shape":
        _member(path, _npy("<f4", "2147483648,"))
    else:
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("actor/hidden_9/bias.npy", _npy("<f4", "67108864,") + bytes(2**28))
    tracemalloc.start()
    with pytest.raises(PolicyError):
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The interpreter's own objects take more memory than a small file, so half a megabyte is
    # allowed.
    assert peak < max(4 * path.stat().st_size, 2**19)


@pytest.mark.parametrize("read", [policy.load, policy_file.read, policy_file.read_meta])
def test_a_large_policy_is_read_with_four_times_its_size_of_memory(
    tmp_path: Path, read: Any
) -> None:
    path = tmp_path / "policy.npz"
    saved(path, policies.arrays(hidden=(2000, 1000)))
    tracemalloc.start()
    read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * path.stat().st_size


def _by_hand(activation: str) -> Policy:
    """Returns a policy with five observations, two hidden units and two actions."""
    hidden = (_f32([[[1, 0], [0, 1], [0, 0], [0, 0], [1, -1]]]), _f32([[0.5, 1]]))
    last = (_f32([[[2, 0], [1, 3]]]), _f32([[0, -1]]))
    return Policy(
        layers=[hidden, last],
        log_std=_f32([[0, 0]]),
        mean=_f32([[1, 0, 0, 0, 0]]),
        std=_f32([[2, 1, 1, 1, 0.5]]),
        is_shared=True,
        encoding="metric",
        max_speed=0.25,
        max_turn_rate=2.0,
        meta={"activation": activation, "observation": {"limit": 10.0}},
        digest="",
    )


def test_an_action_is_drawn_by_its_own_deviation(tmp_path: Path) -> None:
    given = policies.arrays(learners=3)
    given["actor/log_std"][:] = np.log(np.arange(1, 7).reshape(3, 2) / 10)
    trained = saved(tmp_path / "p.npz", given, **several(3))
    seen = np.zeros((2, 2, SIZE), np.float32)
    normal = _f32([[[1, -1], [2, 0.5]], [[0, 3], [-1, 1]]])
    found = policy.act(trained, seen, normal)
    # Robot 0 has deviations 0.1 and 0.2, robot 1 has 0.3 and 0.4.
    expected = [[[0.1, -0.2], [0.6, 0.2]], [[0, 0.6], [-0.3, 0.4]]]
    np.testing.assert_allclose(found - policy.act(trained, seen), expected, atol=1e-6)
    assert found.dtype == np.float32


def test_mean_action_by_hand() -> None:
    # Robot 0: normalised (2, 3, 0, 0, 4), hidden (2 + 4 + 0.5, 3 - 4 + 1) = (6.5, 0).
    # Robot 1: normalised (-1, 2, 0, 0, 40 -> 10), hidden (9.5, 2 - 10 + 1 < 0 -> 0).
    # Robot 2: normalised (0, 5, 0, 0, -1), hidden (-0.5 -> 0, 5 + 1 + 1).
    seen = _f32([[5, 3, 7, 7, 2], [-1, 2, 7, 7, 20], [1, 5, 7, 7, -0.5]])
    expected = [[13, -1], [19, -1], [7, 20]]
    # All numbers are whole or half numbers, which float32 adds without rounding.
    np.testing.assert_array_equal(policy.act(_by_hand("relu"), seen), expected)


def test_command_by_hand() -> None:
    action = _f32([[[0, 0], [1, -1]], [[-1, 0.5], [3, -7]]])
    expected = [[[0.125, 0], [0.25, -2]], [[0, 1], [0.25, -2]]]
    # All numbers are multiples of 1/8, which float32 holds exactly.
    np.testing.assert_array_equal(policy.command(_by_hand("relu"), action), expected)


def test_commands_are_those_of_the_simulated_drive(tmp_path: Path) -> None:
    trained = saved(tmp_path / "policy.npz")
    action = np.random.default_rng(0).normal(size=(500, 3, 2)).astype(np.float32) * 1.5
    robot = drive.from_config(RobotConfig(max_speed=0.1256, max_turn_rate=3.14))
    np.testing.assert_array_equal(policy.command(trained, action), drive.command(action, robot, np))


@pytest.mark.parametrize(
    ("activation", "function"),
    [
        ("tanh", np.tanh),
        ("relu", lambda x: np.maximum(x, 0.0)),
        ("swish", lambda x: x / (1.0 + np.exp(-x))),
    ],
)
def test_activations_against_float64(tmp_path: Path, activation: str, function: Any) -> None:
    arrays = policies.arrays(hidden=(7,))
    loaded = saved(tmp_path / "policy.npz", arrays, activation=activation)
    seen = policies.seen(loaded, 6)
    exact = {name: array[0].astype(np.float64) for name, array in arrays.items()}
    x = np.clip((seen - exact["normalizer/mean"]) / exact["normalizer/std"], -10, 10)
    x = function(x @ exact["actor/hidden_0/kernel"] + exact["actor/hidden_0/bias"])
    expected = x @ exact["actor/mean/kernel"] + exact["actor/mean/bias"]
    # The sums have SIZE float32 terms of at most 30. Ten such terms round by at most
    # 10 * 30 * 2**-24 = 1.8e-5.
    np.testing.assert_allclose(policy.act(loaded, seen), expected, atol=2e-5)


def test_swish_stays_finite_for_any_float32(tmp_path: Path) -> None:
    arrays = policies.arrays(hidden=(2,))
    arrays["actor/hidden_0/kernel"] = np.zeros_like(arrays["actor/hidden_0/kernel"])
    arrays["actor/hidden_0/bias"] = _f32([[-1e30, 1e30]])
    arrays["actor/mean/kernel"] = np.ones_like(arrays["actor/mean/kernel"])
    arrays["actor/mean/bias"] = _f32([[0, 0]])
    loaded = saved(tmp_path / "policy.npz", arrays, activation="swish")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action = policy.act(loaded, np.zeros((1, SIZE), np.float32))
    np.testing.assert_array_equal(action, _f32([[1e30, 1e30]]))  # swish(-1e30) is 0


def _logistic(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


def test_a_memory_by_hand(tmp_path: Path) -> None:
    """Compares a gated recurrent unit of three numbers over three steps with float64."""
    arrays = policies.remembering(policies.arrays(hidden=(4,)), 3)
    said = {"memory": {"kind": "gru", "size": 3}}
    loaded = saved(tmp_path / "policy.npz", arrays, **said)
    exact = {name: array[0].astype(np.float64) for name, array in arrays.items()}
    memory, expected = policy.begin(loaded, (2,)), np.zeros((2, 3))
    for seed in range(3):
        seen = np.random.default_rng(seed).normal(size=(2, SIZE)).astype(np.float32)
        memory, action = policy.step(loaded, memory, seen)
        x = np.clip((seen - exact["normalizer/mean"]) / exact["normalizer/std"], -10, 10)
        x = np.tanh(x @ exact["actor/hidden_0/kernel"] + exact["actor/hidden_0/bias"])
        i = x @ exact["actor/memory/input/kernel"] + exact["actor/memory/input/bias"]
        h = expected @ exact["actor/memory/recurrent/kernel"]
        h += exact["actor/memory/recurrent/bias"]
        reset, update = _logistic(i[:, :3] + h[:, :3]), _logistic(i[:, 3:6] + h[:, 3:6])
        fresh = np.tanh(i[:, 6:] + reset * h[:, 6:])
        expected = (1.0 - update) * fresh + update * expected
        assert memory is not None
        np.testing.assert_allclose(memory, expected, atol=2e-6)  # float32, sums of ten terms
        beside = np.concatenate([x, expected], axis=1)
        wanted = beside @ exact["actor/mean/kernel"] + exact["actor/mean/bias"]
        np.testing.assert_allclose(action, wanted, atol=5e-6)


def test_a_memory_is_handed_in_and_out(tmp_path: Path) -> None:
    said = {"memory": {"kind": "gru", "size": 3}}
    loaded = saved(tmp_path / "a.npz", policies.remembering(policies.arrays(), 3), **said)
    seen = np.zeros((5, 2, SIZE), np.float32)
    with pytest.raises(PolicyError, match=r"^the policy has a memory: use `begin` and `step`"):
        policy.act(loaded, seen)
    with pytest.raises(PolicyError, match=r"^memory is \[2, 3\]: give \[5, 2, 3\], as `begin`"):
        policy.step(loaded, policy.begin(loaded, (2,)), seen)
    with pytest.raises(PolicyError, match=r"^memory is none: give \[5, 2, 3\], as `begin`"):
        policy.step(loaded, None, seen)
    plain = saved(tmp_path / "b.npz")
    assert policy.begin(plain, (5, 2)) is None
    with pytest.raises(PolicyError, match=r"^memory is \[5, 2, 3\]: give none, as `begin`"):
        policy.step(plain, policy.begin(loaded, (5, 2)), seen)


def test_robot_i_of_an_independent_policy_uses_learner_i(tmp_path: Path) -> None:
    arrays = policies.arrays(learners=3)
    together = saved(tmp_path / "all.npz", arrays, **several(3))
    seen = np.random.default_rng(2).normal(size=(4, 3, SIZE)).astype(np.float32)
    action = policy.act(together, seen)
    assert action.shape == (4, 3, ACTIONS)
    for i in range(3):
        alone = saved(tmp_path / f"{i}.npz", {n: a[i : i + 1] for n, a in arrays.items()})
        np.testing.assert_array_equal(action[:, i], policy.act(alone, seen[:, i]))
    np.testing.assert_array_equal(policy.act(together, seen[:, :2]), action[:, :2])
    with pytest.raises(PolicyError, match=r"^4 robots are too many: the policy has 3 networks\.$"):
        policy.act(together, np.zeros((4, SIZE), np.float32))


def test_an_observation_without_an_axis_of_robots_is_refused(tmp_path: Path) -> None:
    alone = saved(tmp_path / "policy.npz")
    for seen in (np.zeros(SIZE, np.float32), [[0.0] * SIZE]):
        with pytest.raises(PolicyError, match=r"^observation has no axis of robots: give an array"):
            policy.act(alone, seen)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("width", [8, 64, 200])
def test_an_action_does_not_depend_on_what_is_computed_beside_it(
    tmp_path: Path, width: int
) -> None:
    loaded = saved(tmp_path / "policy.npz", policies.arrays(hidden=(width, width)))
    seen = np.random.default_rng(3).normal(size=(33, 4, SIZE)).astype(np.float32)
    together = policy.act(loaded, seen)
    alone = np.stack([policy.act(loaded, arena) for arena in seen])
    np.testing.assert_array_equal(together, alone)


def _exported(learner: LearnerState) -> Arrays:
    """Returns a learner's arrays by their names in the policy file."""
    actor = jax.tree.map(lambda leaf: np.asarray(leaf)[None], learner.params["actor"])
    layers = {**actor["torso"], "mean": actor["mean"]}
    arrays = {
        f"actor/{layer}/{part}": layers[layer][part]
        for layer in layers
        for part in ("kernel", "bias")
    }
    arrays["actor/log_std"] = actor["log_std"]
    arrays["normalizer/mean"] = np.asarray(learner.normalizer.mean)[None]
    arrays["normalizer/std"] = np.asarray(learner.normalizer.std)[None]
    return arrays


@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
def test_mean_action_is_the_mode_of_the_learner(tmp_path: Path, activation: Any) -> None:
    config = AlgoConfig(hidden_sizes=(64, 64), activation=activation)
    ppo = PPO.make(config, Sizes(SIZE, ACTIONS), updates=1)
    learner = jax.jit(ppo.init)(jax.random.key(0))
    draw = np.random.default_rng(4)
    # The last layer starts with a gain of 0.01, which is too small to tell networks apart.
    params = jax.tree.map(
        lambda leaf: leaf + 0.1 * draw.normal(size=leaf.shape).astype(np.float32), learner.params
    )
    # The bearing's spread of 1e-9 is below the least deviation that the normaliser divides by.
    names = observation.NAMES
    spread = _f32(by_name(names, infrared=0.01, distance=2.0, bearing=1e-9, other=1.0))
    batch = draw.normal(size=(64, SIZE)).astype(np.float32) * spread
    moments = learner.normalizer.update(jnp.asarray(batch), jnp.ones(64, bool))
    learner = dataclasses.replace(learner, params=params, normalizer=moments)
    loaded = saved(tmp_path / "policy.npz", _exported(learner), activation=activation)
    # Thirty deviations reach beyond the normaliser's limit of 10.
    seen = draw.normal(size=(40, 3, SIZE)).astype(np.float32) * spread * 30
    expected = np.asarray(jax.jit(ppo.act)(learner, seen, jnp.zeros((40, 3, ACTIONS)))[0])
    assert np.ptp(expected, axis=(0, 1)).min() > 1.0  # The observation matters.
    # Three sums of 64 float32 terms or fewer are added in another order. Each is off by about
    # 64 * 2**-24 = 4e-6 of its largest term, which is below 10.
    np.testing.assert_allclose(policy.act(loaded, seen), expected, atol=4e-5)
