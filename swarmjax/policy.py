"""The durable file of a trained policy, `policy.npz`, and what it computes: NumPy only.

Format 1 is an npz archive without pickles. All arrays are little-endian float32; H stands for
the width of a hidden layer. `meta` is a string of JSON that says what the numbers mean.

    actor/hidden_{i}/kernel [L, in, H]    actor/hidden_{i}/bias [L, H]    i = 0, 1, ...
    actor/mean/kernel [L, H, U]           actor/mean/bias [L, U]
    actor/log_std [L, U]                  normalizer/mean, normalizer/std [L, O]
    meta: format, policy, learners, activation,
          observation {names, encoding, units, offset, scale, limit},
          action {names, units, low, high}, config, versions, update, digest
"""

import hashlib
import json
import math
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeGuard

import numpy as np

FORMAT = 1
ACTION_NAMES = ("speed", "turn_rate")
ACTION_UNITS = ("m/s", "rad/s")
ENCODINGS = ("metric", "webots")

_DTYPE = np.dtype("<f4")
_META = {  # what `meta` holds, and as which type of JSON
    "policy": str,
    "learners": int,
    "activation": str,
    "observation": dict,
    "action": dict,
    "config": dict,
    "versions": dict,
    "update": int,
    "digest": str,
}
_KINDS = {str: "text", int: "a whole number", dict: "an object"}
# What a damaged or foreign archive makes NumPy and zipfile raise.
_UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)


class PolicyError(ValueError):
    """A policy that is refused, in one sentence for the person who gave it."""


class Layer(NamedTuple):
    """One dense layer of all learners.

    Attributes:
        kernel: [L, in, out].
        bias: [L, out].
    """

    kernel: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Policy:
    """A trained policy. L is 1 if all robots share it; otherwise robot i is learner i.

    Attributes:
        hidden: Hidden layers, from the observation on.
        mean: The layer that gives the mean action.
        log_std: [L, U], logarithm of the standard deviation that training explored with.
        observation_mean: [L, O], what the observation's normaliser subtracts.
        observation_std: [L, O], what it divides by, above 0.
        meta: As in the file.
    """

    hidden: tuple[Layer, ...]
    mean: Layer
    log_std: np.ndarray
    observation_mean: np.ndarray
    observation_std: np.ndarray
    meta: Mapping[str, Any]

    @property
    def is_shared(self) -> bool:
        """Whether one network serves all robots."""
        return self.meta["policy"] == "shared"

    @property
    def digest(self) -> str:
        """SHA-256 of the arrays, in hexadecimal."""
        return self.meta["digest"]

    @property
    def encoding(self) -> Literal["metric", "webots"]:
        """How the robot's electronics put its observation together, `metric` or `webots`."""
        return self.meta["observation"]["encoding"]

    @property
    def max_speed(self) -> float:
        """Upper end of the commanded speed, m/s; the lower end is 0."""
        return float(self.meta["action"]["high"][0])

    @property
    def max_turn_rate(self) -> float:
        """The commanded turn rate lies within plus or minus this, rad/s."""
        return float(self.meta["action"]["high"][1])


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


def _swish(x: np.ndarray) -> np.ndarray:
    # The logistic function by its identity with tanh, which cannot overflow.
    return 0.5 * x * (1 + np.tanh(0.5 * x))


_ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": _relu,
    "swish": _swish,
}


def mean_action(policy: Policy, observation: np.ndarray) -> np.ndarray:
    """Computes the most likely action of every robot.

    Each robot's vector goes through the network on its own: a product of whole batches rounds
    differently with the number of rows, and an evaluation would depend on how it was split up.

    Args:
        policy: What `load` returned.
        observation: [..., R, O], (quantity - offset) / scale in the order of the policy's
            `observation`, whose units are those of the quantities.

    Returns:
        The mean of the action, [..., R, U], float32 and unbounded; -1..1 spans the command's
        range, `low` to `high` of the policy's `action`.

    Raises:
        PolicyError: If the policy is independent and has fewer learners than there are robots.
    """
    robots, learners = observation.shape[-2], len(policy.log_std)
    if robots > learners and not policy.is_shared:
        raise PolicyError(
            f"the policy is independent and has {learners} learners, one for each robot, "
            f"but there are {robots} robots: evaluate it with at most {learners}."
        )
    # One shared learner stretches over all robots; of independent ones, the first R act.
    mine = slice(robots)
    limit = policy.meta["observation"]["limit"]
    observation = observation.astype(np.float32, copy=False)
    features = (observation - policy.observation_mean[mine]) / policy.observation_std[mine]
    features = np.clip(features, -limit, limit)
    activation = _ACTIVATIONS[policy.meta["activation"]]
    for layer in policy.hidden:
        features = activation(np.vecmat(features, layer.kernel[mine]) + layer.bias[mine])
    return np.vecmat(features, policy.mean.kernel[mine]) + policy.mean.bias[mine]


def save(path: str | Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Writes a policy file, whole or not at all.

    Args:
        path: Of the file; folders that are missing are made.
        arrays: All arrays of the format, by name.
        meta: All of the format's `meta` but `format` and `digest`, which are added.

    Raises:
        PolicyError: If `load` would refuse the file, or if it cannot be written.
    """
    path = Path(path)
    full = {**meta, "format": FORMAT, "digest": digest(arrays)}
    _refuse_in(path, lambda: _check(dict(arrays), full))
    text = json.dumps(full, sort_keys=True, allow_nan=False)
    # Beside the file, so that the move stays within one file system and cannot stop half way.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                np.savez(file, allow_pickle=False, **{**arrays, "meta": np.array(text)})
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise PolicyError(f"{path} cannot be written: {error.strerror or error}.") from None


def load(path: str | Path) -> Policy:
    """Reads a policy file and checks all of it.

    Args:
        path: Of the file.

    Returns:
        The policy.

    Raises:
        PolicyError: If it is missing, damaged, of another format or inconsistent.
    """
    path = Path(path)
    if not path.is_file():
        raise PolicyError(f"{path} is no file: give the path of a policy.npz.")
    if not zipfile.is_zipfile(path):
        raise PolicyError(f"{path} is no npz archive: give the path of a policy.npz.")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except _UNREADABLE as error:
        reason = str(error).strip() or type(error).__name__
        raise PolicyError(f"{path} cannot be read: {reason.splitlines()[0]}.") from None
    return _refuse_in(path, lambda: _build(arrays))


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Computes the SHA-256 over the names, types, shapes and bytes of arrays, names sorted.

    Args:
        arrays: By name.

    Returns:
        64 hexadecimal digits.
    """
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {list(arrays[name].shape)}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _refuse_in[T](path: Path, make: Callable[[], T]) -> T:
    """Puts the file's name before what is wrong with it."""
    try:
        return make()
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None


def _build(arrays: dict[str, np.ndarray]) -> Policy:
    """Makes a policy of everything that a file holds."""
    meta = _parse_meta(arrays.pop("meta", None))
    _check(arrays, meta)
    found = digest(arrays)
    if found != meta["digest"]:
        raise PolicyError(
            f"the digest of the arrays is {found[:12]}..., but meta.digest is "
            f"{meta['digest'][:12]}...: the file was changed or damaged."
        )
    layers = [
        Layer(arrays[f"actor/{name}/kernel"], arrays[f"actor/{name}/bias"])
        for name in (*(f"hidden_{i}" for i in range(_depth(arrays))), "mean")
    ]
    return Policy(
        hidden=tuple(layers[:-1]),
        mean=layers[-1],
        log_std=arrays["actor/log_std"],
        observation_mean=arrays["normalizer/mean"],
        observation_std=arrays["normalizer/std"],
        meta=meta,
    )


def _parse_meta(array: np.ndarray | None) -> dict[str, Any]:
    if array is None:
        raise PolicyError("meta is missing: the file is no policy of this project.")
    if array.shape != () or array.dtype.kind != "U":
        raise PolicyError(
            f"meta is {array.dtype} {list(array.shape)}: expected one string of JSON."
        )
    try:
        meta = json.loads(str(array))
    except (ValueError, RecursionError):
        raise PolicyError("meta cannot be read: expected one string of JSON.") from None
    if not isinstance(meta, dict):
        raise PolicyError(f"meta is {_show(meta)}: expected a JSON object.")
    return meta


def _check(arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Refuses what does not make a policy; the digest aside."""
    if meta.get("format") != FORMAT:
        raise PolicyError(
            f"meta.format is {_show(meta.get('format'))}: this version reads {FORMAT}."
        )
    for key, kind in _META.items():
        _entry(meta, key, kind, "meta")
    _check_choice("policy", meta["policy"], ("shared", "independent"))
    _check_choice("activation", meta["activation"], tuple(_ACTIVATIONS))
    learners = meta["learners"]
    if learners < 1 or (meta["policy"] == "shared" and learners != 1):
        expected = "1 for a shared policy" if meta["policy"] == "shared" else "1 or more"
        raise PolicyError(f"meta.learners is {learners}: expected {expected}.")
    size = _check_observation(meta["observation"])
    _check_action(meta["action"])
    _check_arrays(arrays, learners, size)


def _entry(mapping: Mapping[str, Any], key: str, kind: type, where: str) -> None:
    if key not in mapping:
        raise PolicyError(f"{where}.{key} is missing: expected {_KINDS[kind]}.")
    value = mapping[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise PolicyError(f"{where}.{key} is {_show(value)}: expected {_KINDS[kind]}.")


def _check_choice(key: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise PolicyError(f"meta.{key} is {_show(value)}: expected {' or '.join(choices)}.")


def _check_observation(layout: Mapping[str, Any]) -> int:
    """Checks the layout of the observation and returns its size O."""
    names = _strings(layout, "names")
    units = _strings(layout, "units")
    if len(units) != len(names):
        raise PolicyError(
            f"meta.observation.units has {len(units)} entries: expected {len(names)}, "
            "as many as names."
        )
    encoding = layout.get("encoding")
    if encoding not in ENCODINGS:
        raise PolicyError(
            f"meta.observation.encoding is {_show(encoding)}: expected {' or '.join(ENCODINGS)}."
        )
    for key in ("offset", "scale"):
        _check_numbers(key, layout.get(key), len(names))
    if 0.0 in layout["scale"]:
        raise PolicyError("meta.observation.scale holds 0: it divides.")
    limit = layout.get("limit")
    if not _is_number(limit) or limit <= 0:
        raise PolicyError(f"meta.observation.limit is {_show(limit)}: expected a number above 0.")
    return len(names)


def _check_numbers(key: str, value: object, size: int) -> None:
    if not isinstance(value, list | tuple) or len(value) != size or not all(map(_is_number, value)):
        raise PolicyError(
            f"meta.observation.{key} is {_show(value)}: expected {size} finite numbers."
        )


def _strings(layout: Mapping[str, Any], key: str) -> list[str]:
    value = layout.get(key)
    if not isinstance(value, list | tuple) or not all(isinstance(item, str) for item in value):
        raise PolicyError(f"meta.observation.{key} is {_show(value)}: expected a list of text.")
    return list(value)


def _check_action(layout: Mapping[str, Any]) -> None:
    for key, expected in (("names", ACTION_NAMES), ("units", ACTION_UNITS)):
        found = layout.get(key)
        if not isinstance(found, list | tuple) or tuple(found) != expected:
            raise PolicyError(
                f"meta.action.{key} is {_show(found)}: expected {_show(list(expected))}."
            )
    low, high = (_pair(layout, key) for key in ("low", "high"))
    if high[0] <= 0 or high[1] <= 0 or low != (0.0, -high[1]):
        raise PolicyError(
            f"meta.action.low is {_show(list(low))} and high is {_show(list(high))}: expected "
            "a speed from 0 up and a turn rate within plus or minus one limit."
        )


def _pair(layout: Mapping[str, Any], key: str) -> tuple[float, float]:
    value = layout.get(key)
    if not isinstance(value, list | tuple) or len(value) != 2 or not all(map(_is_number, value)):
        raise PolicyError(f"meta.action.{key} is {_show(value)}: expected two finite numbers.")
    return float(value[0]), float(value[1])


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _check_arrays(arrays: Mapping[str, np.ndarray], learners: int, size: int) -> None:
    """Checks names, then types, shapes and values; `size` is O."""
    depth = _depth(arrays)
    shapes = _shapes(arrays, learners, size, depth)
    for name in shapes:
        if name not in arrays:
            raise PolicyError(f"{name} is missing: the policy has {depth} hidden layers.")
    for name, array in arrays.items():
        if name not in shapes:
            raise PolicyError(f"{name} is not known: format {FORMAT} has no such array.")
        _check_array(name, array, shapes[name])
    if (arrays["normalizer/std"] <= 0).any():
        raise PolicyError("normalizer/std holds a value that is not above 0: it divides.")


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.dtype != _DTYPE:
        raise PolicyError(f"{name} is {array.dtype}: expected float32.")
    if array.shape != shape:
        raise PolicyError(f"{name} has shape {list(array.shape)}: expected {list(shape)}.")
    if not array.size:
        raise PolicyError(f"{name} has shape {list(array.shape)}: expected no axis of 0.")
    if not np.isfinite(array).all():
        raise PolicyError(f"{name} holds a value that is not finite: expected numbers.")


def _depth(arrays: Mapping[str, np.ndarray]) -> int:
    """Counts the hidden layers, at least one."""
    found = {match[0] for name in arrays if (match := re.match(r"actor/hidden_\d+/", name))}
    return max(1, len(found))


def _shapes(
    arrays: Mapping[str, np.ndarray], learners: int, size: int, depth: int
) -> dict[str, tuple[int, ...]]:
    """Returns the shape that each array should have; a bias says how wide its layer is."""
    shapes = {}
    width = size
    for i in range(depth):
        bias = arrays.get(f"actor/hidden_{i}/bias")
        inner = bias.shape[-1] if bias is not None and bias.ndim == 2 else 0
        shapes[f"actor/hidden_{i}/kernel"] = (learners, width, inner)
        shapes[f"actor/hidden_{i}/bias"] = (learners, inner)
        width = inner
    actions = len(ACTION_NAMES)
    shapes["actor/mean/kernel"] = (learners, width, actions)
    shapes["actor/mean/bias"] = shapes["actor/log_std"] = (learners, actions)
    shapes["normalizer/mean"] = shapes["normalizer/std"] = (learners, size)
    return shapes


def _show(value: object) -> str:
    """Writes a value as JSON would, and short."""
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."
