"""Reads and writes policy files (docs/policy-format.md), and checks every field. No JAX.

`policy.load` trusts NumPy's reading of a file; `read` trusts nothing. It does not evaluate a
member's header, but matches it against the one form that NumPy writes. It compares sizes before it
allocates anything.
"""

import io
import json
import math
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from swarmjax import extension, policy
from swarmjax.atomic_file import replacing
from swarmjax.config import ConfigError
from swarmjax.config.reading import parse_json
from swarmjax.policy import (
    FORMAT,
    HEARING_FORMAT,
    MAX_BYTES,
    MAX_ENTRIES,
    MAX_LETTERS,
    MEMORY_FORMAT,
    Policy,
    PolicyError,
)
from swarmjax.policy_network import PolicyNetwork

ACTION_NAMES = ("speed", "turn_rate")
ACTION_UNITS = ("m/s", "rad/s")
ENCODINGS = ("metric", "webots")
ACTIVATIONS = ("tanh", "relu", "swish")
BODIES = ("planar", "wheeled")
RESPONSES = ("ideal", "webots", "real")
ARRIVALS = ("latch", "hold")

_MOST_MEMORY = 1024  # limit of the numbers in a robot's memory
_MOST_HISTORY = 64  # limit of the observations that a policy uses
_MOST_HEARD = 32  # limit of the neighbours, and of the numbers in each message
NETWORK_FORMAT = 3  # for a policy whose network is an extension's code, which is not in the file
_NETWORK = "network/"
_DTYPE = np.dtype("<f4")
_MOST = float(np.finfo(np.float32).max)  # limit for numbers in `meta`, since they become float32
_MOST_LIMIT = 1e6  # limit in standard deviations; above it, float32 sums may overflow
_MEMBER = re.compile(
    r"(actor/(hidden_\d{1,3}|mean|hearing|memory/(input|recurrent))/(kernel|bias)|actor/log_std|"
    r"normalizer/(mean|std)|meta|digest|"
    r"network/(\w{1,64}/){0,8}\w{1,64})\.npy",
    re.ASCII,
)
_MAGIC = b"\x93NUMPY\x01\x00"
_HEADER = re.compile(
    rb"\{'descr': '([<>|][a-zA-Z]\d{0,9})', 'fortran_order': False, "
    rb"'shape': \((N,|N(?:, N){1,7}|)\), \} *\n".replace(b"N", rb"(?:0|[1-9]\d{0,8})")
)
_MOST_LOG_STD = 20.0  # 5e8 times the range of commands; exp(89) overflows float32
_MOST_HEADER = 10_000  # bytes, with all that precedes the header; NumPy reads no longer headers
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
    "config": dict,
    "versions": dict,
    "update": int,
    "seed": int,
}
_KINDS = {str: "text", int: "a whole number", dict: "an object"}
# Exceptions of zipfile for a damaged or foreign archive.
_UNREADABLE = (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile)


def read(path: str | Path, extensions: str | None = None) -> Policy:
    """Reads a policy file and checks all of it.

    Args:
      path: Path of the file.
      extensions: Value of the key with that name, for a policy whose network is an extension's
        code.

    Returns:
      The policy.

    Raises:
      PolicyError: The file is missing, damaged, of another format or inconsistent.
      ConfigError: Its network is not in `extensions`.
    """
    path = Path(path)
    content = _read_bytes(path)
    members, meta = _refuse_in(path, lambda: _check_file(content))
    if "network" in meta:
        return _with_network(path, members, meta, extensions)
    try:
        return policy.load(io.BytesIO(content))
    except PolicyError as error:  # the error's message names the buffer instead of the path
        _, _, reason = str(error).partition(" cannot be read as a policy: ")
        raise PolicyError(f"{path} cannot be read as a policy: {reason}") from None


def read_meta(path: str | Path) -> dict[str, Any]:
    """Reads the description in a policy file, and checks the whole file.

    Args:
      path: Path of the file.

    Returns:
      Its `meta`.

    Raises:
      PolicyError: The file is missing, damaged, of another format or inconsistent.
    """
    path = Path(path)
    content = _read_bytes(path)
    return _refuse_in(path, lambda: _check_file(content))[1]


def _with_network(
    path: Path, members: Mapping[str, np.ndarray], meta: dict[str, Any], extensions: str | None
) -> Policy:
    """Makes a policy whose network is an extension's code."""
    found = extension.load(extensions)
    extension.check_needs(meta.get("extensions", {}), found, str(path), ["network"])
    depth = _depth(members, own=True)
    names = [*(f"hidden_{i}" for i in range(depth)), "mean"]
    arrays = {
        name.removeprefix(_NETWORK): array
        for name, array in members.items()
        if name.startswith(_NETWORK)
    }
    return Policy(
        layers=[(members[f"actor/{n}/kernel"], members[f"actor/{n}/bias"]) for n in names],
        log_std=members["actor/log_std"],
        mean=members["normalizer/mean"],
        std=members["normalizer/std"],
        is_shared=meta["policy"] == "shared",
        encoding=meta["observation"]["encoding"],
        max_speed=meta["action"]["high"][0],
        max_turn_rate=meta["action"]["high"][1],
        meta=meta,
        digest=_text(members, "digest"),
        network=PolicyNetwork(str(extensions), meta["network"], arrays),
    )


def write(path: str | Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Writes a policy file, whole or not at all.

    Args:
      path: Path of the file; missing folders are made.
      arrays: All arrays of the format, by name, except `meta` and `digest`.
      meta: All keys of the format's `meta` except `format`, which is added.

    Raises:
      PolicyError: `read` would refuse the file, or it cannot be written.
    """
    path = Path(path)
    full = {**meta, "format": _format(meta)}
    _refuse_in(path, lambda: check(arrays, full))
    everything = {**arrays, "meta": np.array(json.dumps(full, sort_keys=True, allow_nan=False))}
    everything["digest"] = np.array(policy.digest(everything))
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **everything)
    except OSError as error:
        raise PolicyError(f"{path} cannot be written: {error.strerror or error}.") from None


def check(arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Refuses contents that do not make a policy.

    Args:
      arrays: All arrays of a file except `meta` and `digest`.
      meta: All of the file's `meta`.

    Raises:
      PolicyError: One sentence that names the field.
    """
    own = "network" in meta
    if meta.get("format") != _format(meta):
        raise PolicyError(
            f"meta.format is {_show(meta.get('format'))}, but this version reads {FORMAT}, "
            f"{NETWORK_FORMAT} with meta.network, {MEMORY_FORMAT} with meta.memory or a history, "
            f"and {HEARING_FORMAT} with neighbours: export the policy from its run again."
        )
    if own and not _is_name(meta["network"]):
        raise PolicyError(f"meta.network is {_show(meta['network'])}: expected a name.")
    for key, kind in _META.items():
        _entry(meta, key, kind)
    _choice(meta, "policy", ("shared", "independent"))
    _choice(meta, "activation", ACTIVATIONS)
    for key in ("update", "seed"):
        if meta[key] < 0:
            raise PolicyError(f"meta.{key} is {_show(meta[key])}: expected 0 or more.")
    learners = meta["learners"]
    if learners < 1 or (meta["policy"] == "shared" and learners != 1):
        expected = "1 for a shared policy" if meta["policy"] == "shared" else "1 or more"
        raise PolicyError(f"meta.learners is {_show(learners)}: expected {expected}.")
    _check_optional(meta)
    recalled, heard = _check_memory(meta), _check_neighbours(meta)
    size = _check_observation(meta["observation"]) * _check_history(meta)
    if heard.size > size:
        raise PolicyError(
            f"meta.observation.neighbours takes {heard.size} entries, but meta.observation.names "
            f"has {size}: expected names to include the neighbours' entries."
        )
    actions = _check_action(meta["action"], heard.messages)
    _check_embodiment(meta)
    _check_arrays(arrays, _Sizes(learners, size, recalled, heard, actions), own=own)


def _format(meta: Mapping[str, Any]) -> int:
    """Returns the number of the format that a file with this `meta` has."""
    layout = meta.get("observation")
    if isinstance(layout, Mapping) and "neighbours" in layout:
        return HEARING_FORMAT
    if "memory" in meta or _has_history(meta):
        return MEMORY_FORMAT
    return NETWORK_FORMAT if "network" in meta else FORMAT


def _has_history(meta: Mapping[str, Any]) -> bool:
    """Tells whether a file's policy uses more than the last observation."""
    layout = meta.get("observation")
    history = layout.get("history", 1) if isinstance(layout, Mapping) else 1
    return isinstance(history, int) and history > 1


def _check_history(meta: Mapping[str, Any]) -> int:
    """Checks and returns how many observations the policy uses; 1 if the file does not say."""
    if "history" not in meta["observation"]:
        return 1
    _entry(meta["observation"], "history", int, "meta.observation")
    history = meta["observation"]["history"]
    if not 1 <= history <= _MOST_HISTORY:
        raise PolicyError(
            f"meta.observation.history is {_show(history)}: expected 1 to {_MOST_HISTORY}."
        )
    if history > 1 and "memory" in meta:
        raise PolicyError(
            f"meta.observation.history is {history} beside meta.memory: expected one of them."
        )
    return history


def _check_memory(meta: Mapping[str, Any]) -> int:
    """Checks the file's entry for memory; returns the memory's size H, 0 without one."""
    if "memory" not in meta:
        return 0
    if "network" in meta:
        raise PolicyError("meta.memory and meta.network are both given: expected one of them.")
    _entry(meta, "memory", dict)
    _choice(meta["memory"], "kind", ("gru",), "meta.memory")
    _entry(meta["memory"], "size", int, "meta.memory")
    if not 1 <= meta["memory"]["size"] <= _MOST_MEMORY:
        raise PolicyError(
            f"meta.memory.size is {_show(meta['memory']['size'])}: expected 1 to {_MOST_MEMORY}."
        )
    return meta["memory"]["size"]


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
    for key, least in (("count", 1), ("message_size", 0)):
        _entry(held, key, int, where)
        if not least <= held[key] <= _MOST_HEARD:
            raise PolicyError(
                f"{where}.{key} is {_show(held[key])}: expected {least} to {_MOST_HEARD}."
            )
    _check_positive(held, "range", where)
    if meta["observation"].get("history", 1) != 1:
        raise PolicyError(f"{where} is given beside a history: expected one of them.")
    return _Heard(held["count"], held["message_size"])


def _refuse_in[T](path: Path, make: Callable[[], T]) -> T:
    """Puts the file's name in front of an error."""
    try:
        return make()
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None


# The archive


def _read_bytes(path: Path) -> bytes:
    """Reads a file, unless it is too large for a policy."""
    try:
        if not path.is_file():
            raise PolicyError(f"{path} is no file: give the path of a policy.npz.")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise PolicyError(f"{path} has {size} bytes: a policy has {MAX_BYTES} at most.")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, PolicyError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise PolicyError(f"{path} cannot be read: {reason}.") from None


def _check_file(content: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Refuses an invalid policy file; returns its arrays, with the digest, and meta."""
    members = {name: _parse_array(name, data) for name, data in _unpack(content).items()}
    expected, meta = _text(members, "digest"), _parse_meta(_text(members, "meta"))
    del members["digest"]
    found = policy.digest(members)
    if found != expected:
        raise PolicyError(
            f"digest is {_show(expected[:12])}..., but the content has digest "
            f"{_show(found[:12])}...: the file was changed or damaged."
        )
    del members["meta"]
    check(members, meta)
    return members | {"digest": np.array(expected)}, meta


def _unpack(content: bytes) -> dict[str, bytes]:
    """Returns the members of an archive by the names of their arrays."""
    found: set[str] = set()
    try:
        with policy.open_archive(io.BytesIO(content)) as archive:
            members = archive.infolist()
            for member in members:
                _check_member(member, found)
                found.add(member.filename)
            _check_total(sum(member.file_size for member in members), len(content))
            return {each.filename.removesuffix(".npy"): archive.read(each) for each in members}
    except PolicyError:
        raise
    except _UNREADABLE as error:
        # zipfile quotes a damaged header in full, which does not help a reader.
        said = str(error).strip().partition(" and header ")[0] or type(error).__name__
        reason = _plain(said.splitlines()[0].rstrip("."))
        raise PolicyError(f"it is not a readable npz archive: {reason[:200]}.") from None


def _check_total(total: int, most: int) -> None:
    """Refuses members that overlap: a small file could hold any number of them."""
    if total > most:
        raise PolicyError(
            f"its members have {total} bytes in all: expected at most the {most} of the file."
        )


def _check_member(member: zipfile.ZipInfo, found: Set[str]) -> None:
    """Refuses a member that no policy has, before reading it."""
    name = member.filename
    if not _MEMBER.fullmatch(name):
        raise PolicyError(f"{_show(name)} is not known: format {FORMAT} has no such member.")
    if name in found:
        raise PolicyError(f"{_show(name)} appears more than once: expected each member once.")
    if member.flag_bits & 1 or member.compress_type != zipfile.ZIP_STORED:
        raise PolicyError(f"{_show(name)} is compressed or encrypted: expected stored members.")


def _parse_array(name: str, data: bytes) -> np.ndarray:
    """Reads an array in the single form that NumPy writes for this format."""
    start = len(_MAGIC) + 2 + int.from_bytes(data[len(_MAGIC) : len(_MAGIC) + 2], "little")
    header = _HEADER.fullmatch(data, len(_MAGIC) + 2, start) if data.startswith(_MAGIC) else None
    if header is None or start > _MOST_HEADER:
        raise PolicyError(f"{name} is not a plain array: expected one of npy version 1.0.")
    shape = tuple(int(axis) for axis in header[2].split(b",") if axis)
    try:
        dtype = np.dtype(header[1].decode())
    except (TypeError, ValueError):
        dtype = np.dtype(object)
    if dtype.kind not in "biufcSU" or not dtype.itemsize:
        raise PolicyError(f"{name} is {header[1].decode()}: expected numbers or text.")
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise PolicyError(f"{name} does not have as many values as its shape {list(shape)}.")
    try:
        return np.ndarray(shape, dtype, data, start)
    except ValueError:  # one axis is 0, and the product of the others is too large for NumPy
        raise PolicyError(
            f"{name} has shape {list(shape)}: expected no axis of length 0."
        ) from None


def _text(members: Mapping[str, np.ndarray], name: str) -> str:
    array = members.get(name)
    if array is None:
        raise PolicyError(f"{name} is missing: the file is not a policy of format {FORMAT}.")
    if array.shape != () or not array.dtype.str.startswith("<U"):
        raise PolicyError(f"{name} is {array.dtype} {list(array.shape)}: expected a single string.")
    try:
        return str(array.reshape(-1).view(np.uint8).data, "utf-32-le").rstrip("\0")
    except UnicodeDecodeError:
        raise PolicyError(f"{name} cannot be read: expected text in Unicode.") from None


def _parse_meta(text: str) -> dict[str, Any]:
    if len(text) > MAX_LETTERS or sum(map(text.count, "[{,:")) > MAX_ENTRIES:
        raise PolicyError(
            f"meta cannot be read: expected at most {MAX_LETTERS} characters and {MAX_ENTRIES} "
            "entries."
        )
    try:
        meta = parse_json(text, "meta")
    except ConfigError as error:
        raise PolicyError(str(error)) from None
    if not isinstance(meta, dict):
        raise PolicyError(f"meta is {_show(meta)}: expected a JSON object.")
    return meta


# Contents of `meta`


def _entry(mapping: Mapping[str, Any], key: str, kind: type, where: str = "meta") -> None:
    if key not in mapping:
        raise PolicyError(f"{where}.{key} is missing: expected {_KINDS[kind]}.")
    value = mapping[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise PolicyError(f"{where}.{key} is {_show(value)}: expected {_KINDS[kind]}.")


def _check_optional(meta: Mapping[str, Any]) -> None:
    """Checks the keys that older files lack."""
    for key in ("realism", "extensions"):
        if key in meta:
            _entry(meta, key, dict)
    for name, pieces in meta.get("extensions", {}).items():
        if not _are_texts(pieces):
            raise PolicyError(
                f"meta.extensions.{_show(name)} is {_show(pieces)}: expected digests."
            )
    stages = meta.get("stages", [])
    if not isinstance(stages, list | tuple) or not all(isinstance(x, dict) for x in stages):
        raise PolicyError(f"meta.stages is {_show(stages)}: expected a list of objects.")


def _are_texts(pieces: object) -> bool:
    """Tells whether an object maps names to texts."""
    return isinstance(pieces, dict) and all(isinstance(each, str) for each in pieces.values())


def _choice(
    mapping: Mapping[str, Any], key: str, choices: Sequence[str], where: str = "meta"
) -> None:
    if mapping.get(key) not in choices:
        allowed = " or ".join(choices)
        raise PolicyError(f"{where}.{key} is {_show(mapping.get(key))}: expected {allowed}.")


def _check_observation(layout: Mapping[str, Any]) -> int:
    """Checks the layout of the observation and returns its size O."""
    where = "meta.observation"
    names, units = _words(layout, "names", _NAME), _words(layout, "units", _UNIT)
    if not names or len(set(names)) < len(names):
        raise PolicyError(f"{where}.names is {_show(names)}: expected names that differ.")
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
            f"{where}.limit is {_show(layout['limit'])}: expected at most {_MOST_LIMIT:g}."
        )
    return len(names)


def _words(layout: Mapping[str, Any], key: str, form: re.Pattern[str]) -> list[str]:
    """Returns a list of words that are safe in a comment of any language."""
    value = layout.get(key)
    if not isinstance(value, list | tuple) or not all(
        isinstance(item, str) and form.fullmatch(item) for item in value
    ):
        raise PolicyError(
            f"meta.observation.{key} is {_show(value)}: expected a list of {key} in plain letters."
        )
    return list(value)


def _check_numbers(layout: Mapping[str, Any], key: str, size: int, where: str) -> None:
    value = layout.get(key)
    if not isinstance(value, list | tuple) or len(value) != size or not all(map(_is_number, value)):
        raise PolicyError(f"{where}.{key} is {_show(value)}: expected {size} finite numbers.")


def _check_positive(layout: Mapping[str, Any], key: str, where: str) -> None:
    value = layout.get(key)
    if not _is_number(value) or np.float32(value) <= 0:
        raise PolicyError(f"{where}.{key} is {_show(value)}: expected a number above 0.")


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
        found = layout.get(key)
        if not isinstance(found, list | tuple) or tuple(found) != expected:
            raise PolicyError(
                f"meta.action.{key} is {_show(found)}: expected {_show(list(expected))}."
            )
    for key in ("low", "high"):
        _check_numbers(layout, key, len(every[0]), "meta.action")
    low, high = list(layout["low"]), list(layout["high"])
    said = [1] * messages
    sound = low == [0, -high[1], *(-x for x in said)] and high[2:] == said
    if (np.array(high, np.float32) <= 0).any() or not sound:
        raise PolicyError(
            f"meta.action.low is {_show(low)} and high is {_show(high)}: expected "
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
    if "arrival" in task:  # older files lack this key, and their rule is `latch`
        _choice(task, "arrival", ARRIVALS, "meta.task")


def _check_preset(mapping: Mapping[str, Any], where: str) -> None:
    value = mapping.get("preset")
    if not _is_name(value):
        raise PolicyError(f"{where}.preset is {_show(value)}: expected the name of a preset.")


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
    depth = _depth(arrays, own=own)
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
            raise PolicyError(f"{name} is not known: format {FORMAT} has no such array.")
        _check_array(name, array, shapes[name])
    if (arrays["actor/log_std"] > _MOST_LOG_STD).any():
        raise PolicyError(
            f"actor/log_std holds a value above {_MOST_LOG_STD:g}: expected the logarithm of a "
            "deviation."
        )
    if (arrays["normalizer/std"] <= 0).any():
        raise PolicyError("normalizer/std holds a value of 0 or less, but it is a divisor.")


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
    found = {name: array for name, array in arrays.items() if name.startswith(_NETWORK)}
    return {name: (learners, *array.shape[1:]) for name, array in found.items()}


def _depth(arrays: Mapping[str, np.ndarray], *, own: bool) -> int:
    """Counts the hidden layers; at least one, unless the network is an extension's code."""
    found = {match[0] for name in arrays if (match := re.match(r"actor/hidden_\d+/", name))}
    return len(found) if own else max(1, len(found))


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


def _show(value: object) -> str:
    """Formats a value as short JSON."""
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _plain(text: str) -> str:
    """Removes control characters from text."""
    return text.encode("unicode_escape").decode("ascii")
