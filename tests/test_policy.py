"""The policy file: what it holds, what it refuses, and that it computes what the learner does."""

import dataclasses
import hashlib
import json
import pickle
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax import policy
from swarmjax.config import AlgoConfig
from swarmjax.policy import PolicyError
from swarmjax.ppo import learner as ppo

OBSERVATIONS, ACTIONS = 5, 2
Arrays = dict[str, np.ndarray]


def _f32(values: Any) -> np.ndarray:
    return np.array(values, np.float32)


def _arrays(hidden: tuple[int, ...] = (4, 3), learners: int = 1, seed: int = 0) -> Arrays:
    draw = np.random.default_rng(seed)
    shapes: dict[str, tuple[int, ...]] = {}
    for i, (inner, outer) in enumerate(zip((OBSERVATIONS, *hidden[:-1]), hidden, strict=True)):
        shapes |= {f"actor/hidden_{i}/kernel": (inner, outer), f"actor/hidden_{i}/bias": (outer,)}
    shapes |= {"actor/mean/kernel": (hidden[-1], ACTIONS), "actor/mean/bias": (ACTIONS,)}
    shapes |= {
        "actor/log_std": (ACTIONS,),
        "normalizer/mean": (OBSERVATIONS,),
        "normalizer/std": (OBSERVATIONS,),
    }
    arrays = {
        name: draw.normal(size=(learners, *shape)).astype(np.float32)
        for name, shape in shapes.items()
    }
    arrays["normalizer/std"] = np.abs(arrays["normalizer/std"]) + np.float32(0.1)
    return arrays


def _meta(**changes: Any) -> dict[str, Any]:
    meta = {
        "policy": "shared",
        "learners": 1,
        "activation": "tanh",
        "observation": {
            "names": list("abcde"),
            "encoding": "metric",
            "units": ["m"] * OBSERVATIONS,
            "offset": [0.0] * OBSERVATIONS,
            "scale": [1.0] * OBSERVATIONS,
            "limit": 10.0,
        },
        "action": {
            "names": ["speed", "turn_rate"],
            "units": ["m/s", "rad/s"],
            "low": [0.0, -3.14],
            "high": [0.1256, 3.14],
        },
        "config": {"seed": 3},
        "versions": {"swarmjax": "0.1.0"},
        "update": 17,
    }
    return meta | changes


def _saved(path: Path, arrays: Arrays | None = None, **changes: Any) -> policy.Policy:
    policy.save(path, arrays or _arrays(), _meta(**changes))
    return policy.load(path)


def _write(path: Path, arrays: Arrays, meta: Any) -> None:
    """Writes a file without any check, its digest right unless `meta` brings one."""
    if isinstance(meta, dict):
        meta = {"format": 1, "digest": policy.digest(arrays)} | meta
    np.savez(path, allow_pickle=False, **{**arrays, "meta": np.array(json.dumps(meta))})


def test_a_saved_policy_comes_back_bit_for_bit(tmp_path: Path) -> None:
    arrays = _arrays()
    loaded = _saved(tmp_path / "new" / "policy.npz", arrays)
    for i in range(2):
        for part in ("kernel", "bias"):
            found = getattr(loaded.hidden[i], part)
            np.testing.assert_array_equal(found, arrays[f"actor/hidden_{i}/{part}"])
    np.testing.assert_array_equal(loaded.mean.kernel, arrays["actor/mean/kernel"])
    np.testing.assert_array_equal(loaded.mean.bias, arrays["actor/mean/bias"])
    np.testing.assert_array_equal(loaded.log_std, arrays["actor/log_std"])
    np.testing.assert_array_equal(loaded.observation_mean, arrays["normalizer/mean"])
    np.testing.assert_array_equal(loaded.observation_std, arrays["normalizer/std"])
    assert {key: loaded.meta[key] for key in _meta()} == _meta()
    assert (loaded.is_shared, loaded.max_speed, loaded.max_turn_rate) == (True, 0.1256, 3.14)


def test_the_digest_is_sha256_over_names_types_shapes_and_bytes() -> None:
    b = np.array([[1.0, 2.0]], np.float32)
    expected = hashlib.sha256()
    expected.update(b"a/x <f4 [1]\n" + _f32(3.0).tobytes())
    expected.update(b"b <f4 [1, 2]\n" + b.tobytes())
    assert policy.digest({"b": b, "a/x": _f32([3.0])}) == expected.hexdigest()


def test_mean_action_by_hand(tmp_path: Path) -> None:
    arrays = {
        "normalizer/mean": _f32([[1, 0, 0, 0, 0]]),
        "normalizer/std": _f32([[2, 1, 1, 1, 0.5]]),
        "actor/hidden_0/kernel": _f32([[[1, 0], [0, 1], [0, 0], [0, 0], [1, -1]]]),
        "actor/hidden_0/bias": _f32([[0.5, 1]]),
        "actor/mean/kernel": _f32([[[2, 0], [1, 3]]]),
        "actor/mean/bias": _f32([[0, -1]]),
        "actor/log_std": _f32([[0, 0]]),
    }
    loaded = _saved(tmp_path / "policy.npz", arrays, activation="relu")
    # Robot 0: normalised (2, 3, 0, 0, 4), hidden (2 + 4 + 0.5, 3 - 4 + 1) = (6.5, 0).
    # Robot 1: normalised (-1, 2, 0, 0, 40 -> 10), hidden (9.5, 2 - 10 + 1 < 0 -> 0).
    # Robot 2: normalised (0, 5, 0, 0, -1), hidden (-0.5 -> 0, 5 + 1 + 1).
    seen = _f32([[5, 3, 7, 7, 2], [-1, 2, 7, 7, 20], [1, 5, 7, 7, -0.5]])
    expected = [[13, -1], [19, -1], [7, 20]]
    # All of these are whole or half numbers, which float32 adds without rounding.
    np.testing.assert_array_equal(policy.mean_action(loaded, seen), expected)


@pytest.mark.parametrize(
    ("activation", "function"),
    [
        ("tanh", np.tanh),
        ("relu", lambda x: np.maximum(x, 0.0)),
        ("swish", lambda x: x / (1.0 + np.exp(-x))),
    ],
)
def test_activations_against_float64(tmp_path: Path, activation: str, function: Any) -> None:
    arrays = _arrays(hidden=(7,))
    loaded = _saved(tmp_path / "policy.npz", arrays, activation=activation)
    seen = np.random.default_rng(1).normal(size=(6, OBSERVATIONS)).astype(np.float32)
    exact = {name: array[0].astype(np.float64) for name, array in arrays.items()}
    x = np.clip((seen - exact["normalizer/mean"]) / exact["normalizer/std"], -10, 10)
    x = function(x @ exact["actor/hidden_0/kernel"] + exact["actor/hidden_0/bias"])
    expected = x @ exact["actor/mean/kernel"] + exact["actor/mean/bias"]
    # Sums of up to 7 float32 terms of size 30 at most: 7 * 30 * 2**-24 = 1.3e-5.
    np.testing.assert_allclose(policy.mean_action(loaded, seen), expected, atol=2e-5)


def test_swish_stays_finite_for_any_float32(tmp_path: Path) -> None:
    arrays = _arrays(hidden=(2,))
    arrays["actor/hidden_0/kernel"] = np.zeros_like(arrays["actor/hidden_0/kernel"])
    arrays["actor/hidden_0/bias"] = _f32([[-1e30, 1e30]])
    arrays["actor/mean/kernel"] = np.ones_like(arrays["actor/mean/kernel"])
    arrays["actor/mean/bias"] = _f32([[0, 0]])
    loaded = _saved(tmp_path / "policy.npz", arrays, activation="swish")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action = policy.mean_action(loaded, np.zeros((1, OBSERVATIONS), np.float32))
    np.testing.assert_array_equal(action, _f32([[1e30, 1e30]]))  # swish(-1e30) is 0


def test_robot_i_of_an_independent_policy_uses_learner_i(tmp_path: Path) -> None:
    arrays = _arrays(learners=3)
    together = _saved(tmp_path / "all.npz", arrays, policy="independent", learners=3)
    seen = np.random.default_rng(2).normal(size=(4, 3, OBSERVATIONS)).astype(np.float32)
    action = policy.mean_action(together, seen)
    assert action.shape == (4, 3, ACTIONS)
    for i in range(3):
        alone = _saved(tmp_path / f"{i}.npz", {n: a[i : i + 1] for n, a in arrays.items()})
        np.testing.assert_array_equal(action[:, i], policy.mean_action(alone, seen[:, i]))
    np.testing.assert_array_equal(policy.mean_action(together, seen[:, :2]), action[:, :2])
    with pytest.raises(PolicyError, match=r"has 3 learners.*there are 4 robots.*at most 3\.$"):
        policy.mean_action(together, np.zeros((4, OBSERVATIONS), np.float32))


@pytest.mark.parametrize("width", [8, 64, 200])
def test_an_action_does_not_depend_on_what_is_computed_beside_it(
    tmp_path: Path, width: int
) -> None:
    loaded = _saved(tmp_path / "policy.npz", _arrays(hidden=(width, width)))
    seen = np.random.default_rng(3).normal(size=(33, 4, OBSERVATIONS)).astype(np.float32)
    together = policy.mean_action(loaded, seen)
    alone = np.stack([policy.mean_action(loaded, arena) for arena in seen])
    np.testing.assert_array_equal(together, alone)


def _exported(learner: ppo.LearnerState) -> Arrays:
    """Names a learner's arrays as the file does."""
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
    config = AlgoConfig(hidden=(64, 64), activation=activation)
    learner = ppo.init(jax.random.key(0), config, OBSERVATIONS, ACTIONS, updates=1)
    draw = np.random.default_rng(4)
    # The mean starts with a gain of 0.01, too little to tell networks apart.
    params = jax.tree.map(
        lambda leaf: leaf + 0.1 * draw.normal(size=leaf.shape).astype(np.float32), learner.params
    )
    spread = _f32([0.01, 0.02, 1.0, 2.0, 1e-9])  # of the last, the least one counts
    batch = draw.normal(size=(64, OBSERVATIONS)).astype(np.float32) * spread
    moments = ppo.normalizer.update(learner.normalizer, jnp.asarray(batch), jnp.ones(64, bool))
    learner = dataclasses.replace(learner, params=params, normalizer=moments)
    loaded = _saved(tmp_path / "policy.npz", _exported(learner), activation=activation)
    # Thirty deviations reach beyond the normaliser's limit of 10.
    seen = draw.normal(size=(40, 3, OBSERVATIONS)).astype(np.float32) * spread * 30
    expected = np.asarray(ppo.mode(learner, config, jnp.asarray(seen)))
    assert np.ptp(expected, axis=(0, 1)).min() > 1.0  # the observation matters
    # Three sums of 64 float32 terms or fewer, in another order: some 64 * 2**-24 = 4e-6 of the
    # largest term, which is below 10.
    np.testing.assert_allclose(policy.mean_action(loaded, seen), expected, atol=4e-5)


def test_a_crash_while_writing_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "policy.npz"
    before = _saved(path)

    def crash(file: Any, **_: Any) -> None:
        file.write(b"half a file")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", crash)
    with pytest.raises(KeyboardInterrupt):
        policy.save(path, _arrays(seed=1), _meta())
    assert policy.load(path).digest == before.digest
    assert [found.name for found in tmp_path.iterdir()] == ["policy.npz"]


def test_save_refuses_what_load_would_and_writes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    arrays = _arrays()
    arrays["actor/mean/bias"] = _f32([[np.nan, 0]])
    with pytest.raises(PolicyError, match=r"policy\.npz: actor/mean/bias holds a value"):
        policy.save(path, arrays, _meta())
    assert list(tmp_path.iterdir()) == []


def test_save_says_where_it_cannot_write(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(PolicyError, match=r"file/policy\.npz cannot be written: [^\n]+\.$"):
        policy.save(tmp_path / "file" / "policy.npz", _arrays(), _meta())


def _without(name: str) -> Arrays:
    return {key: array for key, array in _arrays().items() if key != name}


def _with(name: str, array: Any) -> Arrays:
    return _arrays() | {name: np.asarray(array)}


_ACTION = _meta()["action"]
_OBSERVATION = _meta()["observation"]


@pytest.mark.parametrize(
    ("arrays", "meta", "sentence"),
    [
        (_without("actor/mean/bias"), {}, r"actor/mean/bias is missing"),
        (_without("actor/hidden_0/kernel"), {}, r"actor/hidden_0/kernel is missing"),
        (_without("normalizer/std"), {}, r"normalizer/std is missing"),
        (_with("critic/bias", _f32([1])), {}, r"critic/bias is not known: format 1"),
        (
            _with("actor/log_std", np.zeros((1, 2))),
            {},
            r"actor/log_std is float64: expected float32",
        ),
        (
            _with("actor/mean/bias", _f32([[1, 2, 3]])),
            {},
            r"actor/mean/bias has shape \[1, 3\]: expected \[1, 2\]",
        ),
        (
            _with("normalizer/mean", np.zeros((1, 4), np.float32)),
            {},
            r"normalizer/mean has shape \[1, 4\]: expected \[1, 5\]",
        ),
        (
            _arrays(learners=2),
            {},
            r"actor/hidden_0/kernel has shape \[2, 5, 4\]: expected \[1, 5, 4\]",
        ),
        (
            _arrays(hidden=(0,)),
            {},
            r"actor/hidden_0/kernel has shape \[1, 5, 0\]: expected no axis of 0",
        ),
        (
            _with("actor/hidden_1/bias", _f32([[0, np.inf, 0]])),
            {},
            r"actor/hidden_1/bias holds a value that is not finite",
        ),
        (
            _with("normalizer/std", _f32([[1, 1, 0, 1, 1]])),
            {},
            r"normalizer/std holds a value that is not above 0",
        ),
        (_arrays(), {"format": 2}, r"meta.format is 2: this version reads 1"),
        (_arrays(), {"activation": "gelu"}, r'meta.activation is "gelu": expected tanh or relu'),
        (_arrays(), {"policy": "mine"}, r'meta.policy is "mine": expected shared or independent'),
        (_arrays(), {"learners": True}, r"meta.learners is true: expected a whole number"),
        (_arrays(), {"learners": 2}, r"meta.learners is 2: expected 1 for a shared policy"),
        (
            _arrays(),
            {"policy": "independent", "learners": 0},
            r"meta.learners is 0: expected 1 or more",
        ),
        (_arrays(), {"update": "now"}, r'meta.update is "now": expected a whole number'),
        (_arrays(), {"versions": None}, r"meta.versions is null: expected an object"),
        (
            _arrays(),
            {"observation": _OBSERVATION | {"names": "abcde"}},
            r'meta.observation.names is "abcde": expected a list of text',
        ),
        (
            _arrays(),
            {"observation": _OBSERVATION | {"units": ["m"]}},
            r"meta.observation.units has 1 entries: expected 5",
        ),
        (
            _arrays(),
            {"observation": _OBSERVATION | {"encoding": "feet"}},
            r'meta.observation.encoding is "feet": expected metric or webots',
        ),
        (
            _arrays(),
            {"observation": _OBSERVATION | {"offset": [0.0]}},
            r"meta.observation.offset is \[0.0\]: expected 5 finite numbers",
        ),
        (
            _arrays(),
            {"observation": _OBSERVATION | {"scale": [1.0, 0.0, 1.0, 1.0, 1.0]}},
            r"meta.observation.scale holds 0: it divides",
        ),
        (
            _arrays(),
            {"observation": _OBSERVATION | {"limit": float("nan")}},
            r"meta.observation.limit is NaN: expected a number above 0",
        ),
        (
            _arrays(),
            {"action": _ACTION | {"names": ["turn_rate", "speed"]}},
            r'meta.action.names is \["turn_rate", "speed"\]: expected \["speed", "turn_rate"\]',
        ),
        (
            _arrays(),
            {"action": _ACTION | {"high": [0.1]}},
            r"meta.action.high is \[0.1\]: expected two finite numbers",
        ),
        (
            _arrays(),
            {"action": _ACTION | {"low": [-0.1, -3.14]}},
            r"meta.action.low is \[-0.1, -3.14\].*a speed from 0 up",
        ),
        (
            _arrays(seed=1),
            {"digest": policy.digest(_arrays())},
            r"the digest of the arrays is \w{12}\.\.\., but meta.digest is \w{12}\.\.\.: ",
        ),
    ],
)
def test_load_refuses_in_one_sentence(
    tmp_path: Path, arrays: Arrays, meta: dict[str, Any], sentence: str
) -> None:
    path = tmp_path / "policy.npz"
    _write(path, arrays, _meta() | meta)
    with pytest.raises(PolicyError, match=rf"policy\.npz: {sentence}[^\n]*\.$"):
        policy.load(path)


@pytest.mark.parametrize("key", ["policy", "learners", "observation", "action", "config", "digest"])
def test_load_names_what_meta_lacks(tmp_path: Path, key: str) -> None:
    arrays = _arrays()
    meta = {"format": 1, "digest": policy.digest(arrays)} | _meta()
    del meta[key]
    path = tmp_path / "policy.npz"
    np.savez(path, allow_pickle=False, **{**arrays, "meta": np.array(json.dumps(meta))})
    with pytest.raises(PolicyError, match=rf"policy\.npz: meta\.{key} is missing"):
        policy.load(path)


@pytest.mark.parametrize(
    ("meta", "sentence"),
    [
        (None, r"meta is missing: "),
        (np.array("{"), r"meta cannot be read: "),
        (np.array("[1]"), r"meta is \[1\]: expected a JSON object"),
        (np.zeros(3), r"meta is float64 \[3\]: expected one string of JSON"),
    ],
)
def test_load_refuses_foreign_meta(tmp_path: Path, meta: np.ndarray | None, sentence: str) -> None:
    path = tmp_path / "policy.npz"
    np.savez(path, allow_pickle=False, **(_arrays() | ({} if meta is None else {"meta": meta})))
    with pytest.raises(PolicyError, match=rf"policy\.npz: {sentence}"):
        policy.load(path)


def test_load_refuses_what_is_no_archive(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"none\.npz is no file: "):
        policy.load(tmp_path / "none.npz")
    with pytest.raises(PolicyError, match=r" is no file: "):
        policy.load(tmp_path)
    text = tmp_path / "text.npz"
    text.write_text("weights")
    with pytest.raises(PolicyError, match=r"text\.npz is no npz archive: "):
        policy.load(text)


def test_load_refuses_a_damaged_archive(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    _saved(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(PolicyError, match=r"policy\.npz is no npz archive"):
        policy.load(path)
    # One byte of an array's data, which the archive's own checksum covers.
    middle = whole.index(_arrays()["actor/mean/kernel"].tobytes())
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    with pytest.raises(PolicyError, match=r"policy\.npz cannot be read: [^\n]*\.$"):
        policy.load(path)


class _Trap:
    """Opens a door when it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return exec, ("raise AssertionError('unpickled')",)


def test_load_unpickles_nothing(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="unpickled"):  # the trap works
        pickle.loads(pickle.dumps(_Trap()))
    path = tmp_path / "policy.npz"
    trap = np.empty((), object)
    trap[()] = _Trap()
    np.savez(path, allow_pickle=True, **(_arrays() | {"meta": trap}))
    with pytest.raises(PolicyError, match=r"policy\.npz cannot be read: [^\n]*\.$"):
        policy.load(path)
