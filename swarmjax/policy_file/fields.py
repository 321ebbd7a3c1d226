"""Checks what a policy file holds: the fields of `meta`, and the arrays. Needs no JAX."""

import json
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from swarmjax.policy import FORMAT, PolicyError

ACTION_NAMES = ("speed", "turn_rate")
ACTION_UNITS = ("m/s", "rad/s")
NETWORK = "network/"  # how the names of an extension's arrays begin

_LAST_READER = "d8b3078"  # the last commit that reads formats 2 to 4
_DTYPE = np.dtype("<f4")
_MOST = float(np.finfo(np.float32).max)  # limit for numbers in `meta`, since they become float32
_SMALLEST = float(np.finfo(np.float32).tiny)
# The highest `observation.limit`, in standard deviations. Above it, float32 sums may overflow.
_MOST_LIMIT = 1e6
_OWN_ARRAY = re.compile(NETWORK + r"(\w{1,64}/){0,8}\w{1,64}", re.ASCII)
_NAME = re.compile(r"[a-zA-Z][\w.-]{0,63}", re.ASCII)
_UNIT = re.compile(r"(?!.*(?:\*/|/\*))[a-zA-Z0-9/^*. -]{1,16}")  # cannot open or close a comment


class _Rule(NamedTuple):
    """What a field must hold, in words and as a test."""

    expected: str
    holds: Callable[[Any], bool]


def _is_whole(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> TypeGuard[float]:
    # The comparison also works for integers that no float can hold.
    return (_is_whole(value) or isinstance(value, float)) and -_MOST <= value <= _MOST


def _is_word(value: object, form: re.Pattern[str]) -> bool:
    return isinstance(value, str) and form.fullmatch(value) is not None


def _are(value: object, is_sound: Callable[[Any], bool]) -> bool:
    return isinstance(value, list | tuple) and all(map(is_sound, value))


def _one_of(*choices: str) -> _Rule:
    return _Rule(" or ".join(choices), lambda value: value in choices)


def _whole(least: int, most: int | None = None) -> _Rule:
    ends = f", {least} or more" if most is None else f" from {least} to {most}"
    high = float("inf") if most is None else most
    return _Rule(f"a whole number{ends}", lambda value: _is_whole(value) and least <= value <= high)


def _words(kind: str, form: re.Pattern[str]) -> _Rule:
    """Makes the rule for a list of words that cannot open or close a comment in source code."""
    return _Rule(
        f"a list of {kind} in plain letters",
        lambda value: _are(value, lambda word: _is_word(word, form)),
    )


def _numbers(count: int) -> _Rule:
    return _Rule(
        f"{count} finite numbers", lambda value: _are(value, _is_number) and len(value) == count
    )


def _exactly(words: tuple[str, ...]) -> _Rule:
    return _Rule(
        json.dumps(words), lambda value: isinstance(value, list | tuple) and tuple(value) == words
    )


_OBJECT = _Rule("an object", lambda value: isinstance(value, dict))
_POSITIVE = _Rule(
    "a number above 0", lambda value: _is_number(value) and bool(np.float32(value) > 0)
)
_NAMED = _Rule("a name", lambda value: _is_word(value, _NAME))
_FIELDS = {  # of `meta`; an object comes before the fields that it holds
    "policy": _one_of("shared", "independent"),
    "learners": _whole(1),
    "activation": _one_of("tanh", "relu", "swish"),
    "update": _whole(0),
    "seed": _whole(0),
    "config": _OBJECT,
    "versions": _OBJECT,
    "realism": _OBJECT,
    "stages": _Rule("a list of objects", lambda value: _are(value, _OBJECT.holds)),
    "extensions": _Rule(
        "an object of digests by kind and name",
        lambda value: (
            _OBJECT.holds(value)
            and all(
                _OBJECT.holds(pieces) and _are(list(pieces.values()), lambda x: isinstance(x, str))
                for pieces in value.values()
            )
        ),
    ),
    "observation": _OBJECT,
    "observation.names": _words("names", _NAME),
    "observation.units": _words("units", _UNIT),
    "observation.encoding": _one_of("metric", "webots"),
    "observation.limit": _Rule(
        f"a number above 0, at most {_MOST_LIMIT:g}",
        lambda value: _POSITIVE.holds(value) and bool(value <= _MOST_LIMIT),
    ),
    "action": _OBJECT,
    "action.names": _exactly(ACTION_NAMES),
    "action.units": _exactly(ACTION_UNITS),
    "action.low": _numbers(2),
    "action.high": _numbers(2),
    "robot": _OBJECT,
    "robot.preset": _NAMED,
    "robot.body": _one_of("planar", "wheeled"),
    "robot.wheel_radius": _POSITIVE,
    "robot.track": _POSITIVE,
    "robot.max_wheel_speed": _POSITIVE,
    "sensors": _OBJECT,
    "sensors.preset": _NAMED,
    "sensors.response": _one_of("ideal", "webots", "real"),
    "sensors.range": _POSITIVE,
    "task": _OBJECT,
    "task.control_step": _POSITIVE,
    "task.target_radius": _POSITIVE,
    "task.arrival": _one_of("latch", "hold"),
}
_OPTIONAL = {  # fields of `meta` that may be missing, each with the rules that it must meet
    "network": {"network": _NAMED},
    "memory": {
        "memory": _OBJECT,
        "memory.kind": _one_of("gru"),
        "memory.size": _whole(1, 1024),
    },
    "task.goal": {"task.goal": _NAMED},
    "task.step_limit": {"task.step_limit": _whole(1)},
    "observation.neighbours": {
        "observation.neighbours": _Rule(
            "nothing, because commit 8820a9f is the last that reads it", lambda _: False
        ),
    },
}
_MISSING = object()


def check(arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Refuses contents that are not a valid policy.

    Args:
      arrays: All arrays of a file except `meta` and `digest`.
      meta: All of the file's `meta`.

    Raises:
      PolicyError: The contents are refused, in one sentence that names the field.
    """
    if meta.get("format") != FORMAT:
        raise PolicyError(
            f"meta.format is {short_json(meta.get('format'))}, but this version reads only format "
            f"{FORMAT}: commit {_LAST_READER} is the last that reads formats 2 to 4."
        )
    _check_fields(meta, _FIELDS)
    for field, rules in _OPTIONAL.items():
        if _value(meta, field) is not _MISSING:
            _check_fields(meta, rules)
            if field == "memory" and "network" in meta:
                raise PolicyError(
                    "meta.memory and meta.network are both given: expected only one of the two."
                )
    if meta["policy"] == "shared" and meta["learners"] != 1:
        raise PolicyError(f"meta.learners is {meta['learners']}: expected 1 for a shared policy.")
    _check_observation(meta)
    _check_action(meta["action"])
    _check_arrays(arrays, meta)


def _value(meta: Mapping[str, Any], field: str) -> Any:
    """Returns the value of a field such as `robot.track`; `_MISSING` if there is none."""
    value: Any = meta
    for key in field.split("."):
        value = value.get(key, _MISSING)
    return value


def _check_fields(meta: Mapping[str, Any], rules: Mapping[str, _Rule]) -> None:
    for field, rule in rules.items():
        value = _value(meta, field)
        if value is _MISSING:
            raise PolicyError(f"meta.{field} is missing: expected {rule.expected}.")
        if not rule.holds(value):
            raise PolicyError(f"meta.{field} is {short_json(value)}: expected {rule.expected}.")


def _check_observation(meta: Mapping[str, Any]) -> None:
    """Checks that the lists in `meta.observation` have the same length and differing names."""
    layout, names = meta["observation"], meta["observation"]["names"]
    if not names or len(set(names)) < len(names):
        raise PolicyError(
            f"meta.observation.names is {short_json(names)}: expected different names."
        )
    if len(layout["units"]) != len(names):
        raise PolicyError(
            f"meta.observation.units has {len(layout['units'])} entries: expected {len(names)}, "
            "as many as names."
        )
    rule = _numbers(len(names))
    _check_fields(meta, {"observation.offset": rule, "observation.scale": rule})
    if not np.array(layout["scale"], np.float32).all():
        raise PolicyError("meta.observation.scale holds 0, but observations are divided by scale.")


def _check_action(layout: Mapping[str, Any]) -> None:
    low, high = list(layout["low"]), list(layout["high"])
    if (np.array(high, np.float32) <= 0).any() or low != [0, -high[1]]:
        raise PolicyError(
            f"meta.action.low is {short_json(low)} and high is {short_json(high)}: expected "
            "a speed from 0 to high and a turn rate from -high to high."
        )


# Arrays


def _check_arrays(arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Checks the names of the arrays first, then types, shapes and values."""
    shapes = _shapes(arrays, meta)
    for name in shapes:
        if name not in arrays:
            depth = _hidden_layers(arrays, meta)
            raise PolicyError(f"array {name} is missing: the policy has {depth} hidden layers.")
    for name, array in arrays.items():
        if name not in shapes:
            raise PolicyError(
                f"array {short_json(name)} is unknown: format {FORMAT} has no array of this name."
            )
        _check_array(name, array, shapes[name])
    if (arrays["normalizer/std"] < _SMALLEST).any():
        raise PolicyError(
            f"normalizer/std holds a value below {_SMALLEST:.3g}, but observations are divided by "
            "it, and devices round smaller numbers to 0."
        )


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.dtype != _DTYPE:
        raise PolicyError(f"{name} is {array.dtype}: expected float32.")
    if array.shape != shape:
        raise PolicyError(f"{name} has shape {list(array.shape)}: expected {list(shape)}.")
    if not np.isfinite(array).all():
        raise PolicyError(f"{name} holds a value that is not finite: expected finite numbers.")


def _hidden_layers(arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> int:
    """Counts the hidden layers. The result is at least 1, unless an extension has the network."""
    layers = {match[0] for name in arrays if (match := re.match(r"actor/hidden_\d+/", name))}
    return len(layers) if "network" in meta else max(1, len(layers))


def _shapes(
    arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]
) -> dict[str, tuple[int, ...]]:
    """Returns the expected shape of each array. The bias of a hidden layer gives its width."""
    learners, width = meta["learners"], len(meta["observation"]["names"])
    shapes: dict[str, tuple[int, ...]] = {
        f"normalizer/{part}": (learners, width) for part in ("mean", "std")
    }

    def add(layer: str, inputs: int, outputs: int | None = None) -> int:
        """Adds a layer and returns the number of its outputs."""
        bias = arrays.get(f"actor/{layer}/bias", np.empty(0))
        given: int = bias.shape[-1] if bias.ndim == 2 else 0
        width = given if outputs is None else outputs
        shapes[f"actor/{layer}/kernel"] = (learners, inputs, width)
        shapes[f"actor/{layer}/bias"] = (learners, width)
        return width

    depth = _hidden_layers(arrays, meta)
    if "network" in meta:  # its layers come first, and only they know how many features they give
        own = {name: array for name, array in arrays.items() if _OWN_ARRAY.fullmatch(name)}
        shapes |= {name: (learners, *array.shape[1:]) for name, array in own.items()}
        first = arrays.get(f"actor/{'hidden_0' if depth else 'mean'}/kernel")
        width = first.shape[1] if first is not None and first.ndim == 3 else width
    for i in range(depth):
        width = add(f"hidden_{i}", width)
    if "memory" in meta:
        size = meta["memory"]["size"]
        add("memory/input", width, 3 * size)
        add("memory/recurrent", size, 3 * size)
        width += size
    shapes["actor/log_std"] = (learners, add("mean", width, len(ACTION_NAMES)))
    return shapes


def short_json(value: object) -> str:
    """Formats a value as JSON of 80 characters at most, for an error message.

    Args:
      value: Anything; a value of a type that JSON lacks is shown as text.

    Returns:
      The text.
    """
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."
