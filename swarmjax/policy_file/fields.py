"""Checks what a policy file holds: the fields of `meta`, and the arrays. No JAX."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from swarmjax.config.section import LAST_READER
from swarmjax.policy import FORMAT, PolicyError
from swarmjax.policy_file.reach import Inputs, check_reach

ACTION_NAMES = ("speed", "turn_rate")
ACTION_UNITS = ("m/s", "rad/s")
ENCODINGS = ("metric", "webots")
ACTIVATIONS = ("tanh", "relu", "swish")
BODIES = ("planar", "wheeled")
RESPONSES = ("ideal", "webots", "real")
ARRIVALS = ("latch", "hold")

_MOST_MEMORY = 1024  # limit of the numbers in a robot's memory
_MOST_HEARD = 32  # limit of the neighbours, and of the numbers in each message
NETWORK = "network/"  # how the names of an extension's arrays begin
_DTYPE = np.dtype("<f4")
_MOST = float(np.finfo(np.float32).max)  # limit for numbers in `meta`, since they become float32
_SMALLEST = float(np.finfo(np.float32).tiny)
_MOST_LIMIT = 1e6  # limit in standard deviations; above it, float32 sums may overflow
_MOST_LOG_STD = 20.0  # 5e8 times the range of commands; exp(89) overflows float32
_OWN_ARRAY = re.compile(NETWORK + r"(\w{1,64}/){0,8}\w{1,64}", re.ASCII)
_NAME = re.compile(r"[a-zA-Z][\w.-]{0,63}", re.ASCII)
_UNIT = re.compile(r"(?!.*(?:\*/|/\*))[a-zA-Z0-9/^*. -]{1,16}")  # cannot open or close a comment
_META = {  # keys of `meta`, with their JSON types
    "policy": str,
    "learners": int,
    "activation": str,
    "observation": dict,
    "action": dict,
    "robot": dict,
    "sensors": dict,
    "task": dict,
    "realism": dict,
    "stages": list,
    "extensions": dict,
    "config": dict,
    "versions": dict,
    "update": int,
    "seed": int,
}
_KINDS = {str: "text", int: "a whole number", dict: "an object", list: "a list"}


def check(arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Refuses contents that do not make a policy.

    Args:
      arrays: All arrays of a file except `meta` and `digest`.
      meta: All of the file's `meta`.

    Raises:
      PolicyError: One sentence that names the field.
    """
    own = "network" in meta
    if meta.get("format") != FORMAT:
        raise PolicyError(
            f"meta.format is {short_json(meta.get('format'))}, but this version reads {FORMAT} "
            f"only: {LAST_READER} is the last commit that reads formats 2 to 4."
        )
    if own and not _is_name(meta["network"]):
        raise PolicyError(f"meta.network is {short_json(meta['network'])}: expected a name.")
    for key, kind in _META.items():
        _entry(meta, key, kind)
    _choice(meta, "policy", ("shared", "independent"))
    _choice(meta, "activation", ACTIVATIONS)
    for key in ("update", "seed"):
        if meta[key] < 0:
            raise PolicyError(f"meta.{key} is {short_json(meta[key])}: expected 0 or more.")
    learners = meta["learners"]
    if learners < 1 or (meta["policy"] == "shared" and learners != 1):
        expected = "1 for a shared policy" if meta["policy"] == "shared" else "1 or more"
        raise PolicyError(f"meta.learners is {short_json(learners)}: expected {expected}.")
    _check_pieces(meta)
    recalled, heard = _check_memory(meta), _check_neighbours(meta)
    size = _check_observation(meta["observation"])
    if heard.size > size:
        raise PolicyError(
            f"meta.observation.neighbours takes {heard.size} entries, but meta.observation.names "
            f"has {size}: expected names to include the neighbours' entries."
        )
    actions = _check_action(meta["action"], heard.messages)
    _check_embodiment(meta)
    _check_arrays(arrays, _Sizes(learners, size, recalled, heard, actions), own=own)
    limit, bounded = float(meta["observation"]["limit"]), meta["activation"] == "tanh"
    check_reach(arrays, _hidden_layers(arrays, own=own), Inputs(limit, heard.robots, bounded))


def _check_memory(meta: Mapping[str, Any]) -> int:
    """Checks the file's entry for memory; returns the memory's size H, 0 without one."""
    if "memory" not in meta:
        return 0
    if "network" in meta:
        raise PolicyError("meta.memory and meta.network are both given: expected one of them.")
    _entry(meta, "memory", dict)
    _choice(meta["memory"], "kind", ("gru",), "meta.memory")
    return _whole(meta["memory"], "size", 1, _MOST_MEMORY, "meta.memory")


class _Heard(NamedTuple):
    """The number of neighbours that a robot hears, and the length of each message."""

    robots: int = 0
    messages: int = 0

    @property
    def width(self) -> int:
        """Entries of a neighbour: whether there is one, distance, cosine, sine, message."""
        return 4 + self.messages

    @property
    def size(self) -> int:
        """Entries of all neighbours."""
        return self.robots * self.width


class _Sizes(NamedTuple):
    """L, O, H (0 without memory), sizes of hearing, and U."""

    learners: int
    size: int
    recalled: int
    heard: _Heard
    actions: int


def _check_neighbours(meta: Mapping[str, Any]) -> _Heard:
    """Checks and returns the file's settings of neighbours."""
    if "neighbours" not in meta["observation"]:
        return _Heard()
    if "network" in meta:
        raise PolicyError(
            "meta.observation.neighbours and meta.network are both given: expected one of them."
        )
    where = "meta.observation.neighbours"
    _entry(meta["observation"], "neighbours", dict, "meta.observation")
    held = meta["observation"]["neighbours"]
    robots = _whole(held, "count", 1, _MOST_HEARD, where)
    messages = _whole(held, "message_size", 0, _MOST_HEARD, where)
    _check_positive(held, "range", where)
    return _Heard(robots, messages)


# Contents of `meta`


def _entry(mapping: Mapping[str, Any], key: str, kind: type, where: str = "meta") -> None:
    if key not in mapping:
        raise PolicyError(f"{where}.{key} is missing: expected {_KINDS[kind]}.")
    value = mapping[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise PolicyError(f"{where}.{key} is {short_json(value)}: expected {_KINDS[kind]}.")


def _whole(mapping: Mapping[str, Any], key: str, least: int, most: int, where: str) -> int:
    _entry(mapping, key, int, where)
    if not least <= mapping[key] <= most:
        raise PolicyError(
            f"{where}.{key} is {short_json(mapping[key])}: expected {least} to {most}."
        )
    return mapping[key]


def _check_pieces(meta: Mapping[str, Any]) -> None:
    """Checks the stages and the digests of extensions."""
    for name, pieces in meta["extensions"].items():
        if not _are_texts(pieces):
            raise PolicyError(
                f"meta.extensions.{short_json(name)} is {short_json(pieces)}: expected digests."
            )
    if not all(isinstance(stage, dict) for stage in meta["stages"]):
        raise PolicyError(
            f"meta.stages is {short_json(meta['stages'])}: expected a list of objects."
        )


def _are_texts(pieces: object) -> bool:
    """Tells whether an object maps names to texts."""
    return isinstance(pieces, dict) and all(isinstance(each, str) for each in pieces.values())


def _choice(
    mapping: Mapping[str, Any], key: str, choices: Sequence[str], where: str = "meta"
) -> None:
    if mapping.get(key) not in choices:
        allowed = " or ".join(choices)
        raise PolicyError(f"{where}.{key} is {short_json(mapping.get(key))}: expected {allowed}.")


def _check_observation(layout: Mapping[str, Any]) -> int:
    """Checks the layout of the observation and returns its size O."""
    where = "meta.observation"
    names, units = _words(layout, "names", _NAME), _words(layout, "units", _UNIT)
    if not names or len(set(names)) < len(names):
        raise PolicyError(f"{where}.names is {short_json(names)}: expected names that differ.")
    if len(units) != len(names):
        raise PolicyError(
            f"{where}.units has {len(units)} entries: expected {len(names)}, as many as names."
        )
    _choice(layout, "encoding", ENCODINGS, where)
    for key in ("offset", "scale"):
        _check_numbers(layout, key, len(names), where)
    if not np.array(layout["scale"], np.float32).all():
        raise PolicyError(f"{where}.scale holds 0, but it is a divisor.")
    _check_positive(layout, "limit", where)
    if layout["limit"] > _MOST_LIMIT:
        raise PolicyError(
            f"{where}.limit is {short_json(layout['limit'])}: expected at most {_MOST_LIMIT:g}."
        )
    return len(names)


def _words(layout: Mapping[str, Any], key: str, form: re.Pattern[str]) -> list[str]:
    """Returns a list of words that are safe in a comment of any language."""
    value = layout.get(key)
    if not isinstance(value, list | tuple) or not all(
        isinstance(item, str) and form.fullmatch(item) for item in value
    ):
        raise PolicyError(
            f"meta.observation.{key} is {short_json(value)}: "
            f"expected a list of {key} in plain letters."
        )
    return list(value)


def _check_numbers(layout: Mapping[str, Any], key: str, size: int, where: str) -> None:
    value = layout.get(key)
    if not isinstance(value, list | tuple) or len(value) != size or not all(map(_is_number, value)):
        raise PolicyError(f"{where}.{key} is {short_json(value)}: expected {size} finite numbers.")


def _check_positive(layout: Mapping[str, Any], key: str, where: str) -> None:
    value = layout.get(key)
    if not _is_number(value) or np.float32(value) <= 0:
        raise PolicyError(f"{where}.{key} is {short_json(value)}: expected a number above 0.")


def action_layout(messages: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Returns the names and the units of the numbers of an action.

    Args:
      messages: Count of numbers that a robot broadcasts.
    """
    said = tuple(f"message_{i}" for i in range(messages))
    return (*ACTION_NAMES, *said), (*ACTION_UNITS, *("1" for _ in said))


def _check_action(layout: Mapping[str, Any], messages: int) -> int:
    """Checks the layout of the action and returns its size U."""
    every = action_layout(messages)
    for key, expected in zip(("names", "units"), every, strict=True):
        given = layout.get(key)
        if not isinstance(given, list | tuple) or tuple(given) != expected:
            raise PolicyError(
                f"meta.action.{key} is {short_json(given)}: expected {short_json(list(expected))}."
            )
    for key in ("low", "high"):
        _check_numbers(layout, key, len(every[0]), "meta.action")
    low, high = list(layout["low"]), list(layout["high"])
    said = [1] * messages
    sound = low == [0, -high[1], *(-x for x in said)] and high[2:] == said
    if (np.array(high, np.float32) <= 0).any() or not sound:
        raise PolicyError(
            f"meta.action.low is {short_json(low)} and high is {short_json(high)}: expected "
            "a speed from 0 to high and a turn rate from -high to high"
            f"{', and messages from -1 to 1' if messages else ''}."
        )
    return len(every[0])


def _check_embodiment(meta: Mapping[str, Any]) -> None:
    """Checks the robot, the sensors and the task of the policy's training."""
    robot, sensors, task = meta["robot"], meta["sensors"], meta["task"]
    _check_preset(robot, "meta.robot")
    _choice(robot, "body", BODIES, "meta.robot")
    for key in ("wheel_radius", "track", "max_wheel_speed"):
        _check_positive(robot, key, "meta.robot")
    _check_preset(sensors, "meta.sensors")
    _choice(sensors, "response", RESPONSES, "meta.sensors")
    _check_positive(sensors, "range", "meta.sensors")
    for key in ("control_step", "target_radius"):
        _check_positive(task, key, "meta.task")
    _choice(task, "arrival", ARRIVALS, "meta.task")


def _check_preset(mapping: Mapping[str, Any], where: str) -> None:
    value = mapping.get("preset")
    if not _is_name(value):
        raise PolicyError(f"{where}.preset is {short_json(value)}: expected the name of a preset.")


def _is_name(value: object) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def _is_number(value: object) -> TypeGuard[float]:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return -_MOST <= value <= _MOST  # works for integers beyond a float's range too


# Arrays


def _check_arrays(arrays: Mapping[str, np.ndarray], sizes: _Sizes, *, own: bool) -> None:
    """Checks names, then types, shapes and values.

    `own` tells whether the network is an extension's code.
    """
    learners, size = sizes.learners, sizes.size
    depth = _hidden_layers(arrays, own=own)
    first = arrays.get(f"actor/{'hidden_0' if depth else 'mean'}/kernel")
    known = own and first is not None and first.ndim == 3
    width = first.shape[1] if known and first is not None else size
    shapes = _shapes(arrays, sizes, width, depth)
    if own:
        shapes |= _network_shapes(arrays, learners)
    for name in shapes:
        if name not in arrays:
            raise PolicyError(f"{name} is missing: the policy has {depth} hidden layers.")
    for name, array in arrays.items():
        if name not in shapes:
            raise PolicyError(
                f"{short_json(name)} is not known: format {FORMAT} has no such array."
            )
        _check_array(name, array, shapes[name])
    if (arrays["actor/log_std"] > _MOST_LOG_STD).any():
        raise PolicyError(
            f"actor/log_std holds a value above {_MOST_LOG_STD:g}: expected the logarithm of a "
            "deviation."
        )
    if (arrays["normalizer/std"] < _SMALLEST).any():
        raise PolicyError(
            f"normalizer/std holds a value below {_SMALLEST:.3g}, but it is a divisor, and devices "
            "take smaller numbers for 0."
        )


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.dtype != _DTYPE:
        raise PolicyError(f"{name} is {array.dtype}: expected float32.")
    if array.shape != shape:
        raise PolicyError(f"{name} has shape {list(array.shape)}: expected {list(shape)}.")
    if not array.size:
        raise PolicyError(f"{name} has shape {list(array.shape)}: expected no axis of length 0.")
    if not np.isfinite(array).all():
        raise PolicyError(f"{name} holds a value that is not finite: expected numbers.")


def _network_shapes(arrays: Mapping[str, np.ndarray], learners: int) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of an extension's network arrays; each has an axis of learners."""
    own = {name: array for name, array in arrays.items() if _OWN_ARRAY.fullmatch(name)}
    return {name: (learners, *array.shape[1:]) for name, array in own.items()}


def _hidden_layers(arrays: Mapping[str, np.ndarray], *, own: bool) -> int:
    """Counts the hidden layers; at least one, unless the network is an extension's code."""
    layers = {match[0] for name in arrays if (match := re.match(r"actor/hidden_\d+/", name))}
    return len(layers) if own else max(1, len(layers))


def _shapes(
    arrays: Mapping[str, np.ndarray], sizes: _Sizes, width: int, depth: int
) -> dict[str, tuple[int, ...]]:
    """Returns the expected shape of each array; the width of a layer comes from its bias.

    `width` is the input size of the first layer, for a policy without neighbours.
    """
    shapes, (learners, size, recalled, heard, actions) = {}, sizes
    if heard.robots:
        bias = arrays.get("actor/hearing/bias")
        inner = bias.shape[-1] if bias is not None and bias.ndim == 2 else 0
        shapes["actor/hearing/kernel"] = (learners, heard.width, inner)
        shapes["actor/hearing/bias"] = (learners, inner)
        width += inner - heard.size
    for i in range(depth):
        bias = arrays.get(f"actor/hidden_{i}/bias")
        inner = bias.shape[-1] if bias is not None and bias.ndim == 2 else 0
        shapes[f"actor/hidden_{i}/kernel"] = (learners, width, inner)
        shapes[f"actor/hidden_{i}/bias"] = (learners, inner)
        width = inner
    if recalled:
        gates = 3 * recalled
        shapes["actor/memory/input/kernel"] = (learners, width, gates)
        shapes["actor/memory/recurrent/kernel"] = (learners, recalled, gates)
        for part in ("input", "recurrent"):
            shapes[f"actor/memory/{part}/bias"] = (learners, gates)
        width += recalled
    shapes["actor/mean/kernel"] = (learners, width, actions)
    shapes["actor/mean/bias"] = shapes["actor/log_std"] = (learners, actions)
    shapes["normalizer/mean"] = shapes["normalizer/std"] = (learners, size)
    return shapes


def short_json(value: object) -> str:
    """Formats a value as JSON of 80 characters at most, for an error message.

    Args:
      value: Anything; what JSON lacks is shown as text.

    Returns:
      The text.
    """
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."
