"""Runs a trained `policy.npz` with NumPy alone: copy this one file (docs/policy-format.md)."""

import hashlib
import json
import math
import zipfile
from contextlib import nullcontext
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

FORMAT = 2
MAX_BYTES = 2**30  # of all arrays; those of two layers of 64 take 20 kB
_MAX_LIST = 2**16  # bytes of the list of members, of which a name takes a hundred
MAX_LETTERS = 2**20  # of `meta`, each four bytes
MAX_ENTRIES = 2**16  # of `meta`, of which each may take a hundred bytes and more
_ACTIVATIONS = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "swish": lambda x: 0.5 * x * (1 + np.tanh(0.5 * x)),  # x * logistic(x), without overflow
}


class PolicyError(ValueError):
    """A policy that is refused, in one sentence for the person who gave it."""


class Policy(NamedTuple):
    """A trained policy. L is 1 if all robots share it; otherwise robot i is learner i."""

    layers: list[tuple[np.ndarray, np.ndarray]]  # kernel [L, in, out] and bias [L, out]
    log_std: np.ndarray  # [L, U], logarithm of the deviation of the action
    mean: np.ndarray  # [L, O], of the observation
    std: np.ndarray  # [L, O], likewise
    is_shared: bool
    encoding: Any  # "metric" or "webots"
    max_speed: float  # m/s; commands begin at 0
    max_turn_rate: float  # rad/s, to either side
    meta: dict[str, Any]
    digest: str  # SHA-256 of all else in the file, in hexadecimal
    network: Any = None  # of format 3: normalised [..., R, O] to features


def load(path: str | Path | IO[bytes]) -> Policy:
    """Returns the policy in a file (path, or open in binary); PolicyError if it is none."""
    try:
        if isinstance(path, str | Path) and Path(path).exists() and not Path(path).is_file():
            raise ValueError("it is no plain file")  # a pipe would be waited for
        with open(path, "rb") if isinstance(path, str | Path) else nullcontext(path) as file:
            arrays = _read(file)
        found, text = _text(arrays.pop("digest")), _text(arrays["meta"])
        if sum(map(text.count, "[{,:")) > MAX_ENTRIES:
            raise ValueError(f"meta has more than {MAX_ENTRIES} entries")
        meta = json.loads(text)
        if meta["format"] != FORMAT:
            raise ValueError(f"meta.format is {json.dumps(meta['format'])[:80]}, not {FORMAT}")
        if found != digest(arrays):
            raise ValueError("digest is not that of the arrays")
        names = [*(f"hidden_{i}" for i in range((len(arrays) - 6) // 2)), "mean"]
        layers = [(arrays[f"actor/{n}/kernel"], arrays[f"actor/{n}/bias"]) for n in names]
        rest = [arrays[n] for n in ("actor/log_std", "normalizer/mean", "normalizer/std")]
        rest += [meta["policy"] == "shared", meta["observation"]["encoding"]]
        return Policy(*[layers, *rest, *meta["action"]["high"], meta, found])
    except Exception as error:  # whatever a damaged file makes zipfile, NumPy and json raise
        reason = str(error).partition("\n")[0].rstrip(".") or type(error).__name__
        raise PolicyError(f"{path} cannot be read as a policy: {reason[:200]}.") from None


def open_archive(file: IO[bytes]) -> zipfile.ZipFile:
    """Opens an archive after a look at its end, which says how much zipfile would read of it."""
    file.seek(max(0, file.seek(0, 2) - 42))
    end = file.read()
    if end[-22:-18] != b"PK\5\6":
        raise zipfile.BadZipFile("File is not a zip file")
    if end[:4] == b"PK\6\7" or int.from_bytes(end[-10:-6], "little") > _MAX_LIST:
        raise ValueError(f"its list of members has more than {_MAX_LIST} bytes")
    return zipfile.ZipFile(file)


def _read(file: IO[bytes]) -> dict[str, np.ndarray]:
    """Reads the arrays of an archive; nothing is unpacked that takes more room than the file."""
    with open_archive(file) as archive:
        members, size = archive.infolist(), file.seek(0, 2)
        if size > MAX_BYTES or sum(member.file_size for member in members) > size:
            raise ValueError(f"it unpacks to more than the file, or {MAX_BYTES} bytes")
        plain = {x.filename for x in members if not (x.compress_type or x.flag_bits & 1)}
        if len(plain) < len(members):
            raise ValueError("a member is compressed, encrypted or there twice")
        return {x.filename.removesuffix(".npy"): read_array(archive, x) for x in members}


def read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Reads a member whose header says neither more nor less than there is."""
    with archive.open(member) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError(f"{member.filename!r} is not of npy version 1.0")
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
        size = file.tell() + math.prod(shape) * dtype.itemsize
        if dtype.hasobject or is_fortran or size != member.file_size:
            raise ValueError(f"{member.filename!r} is not the array that its header tells of")
        return np.frombuffer(file.read(), dtype).reshape(shape)


def _text(array: np.ndarray) -> str:
    if array.dtype.kind == "U" and not array.shape and array.itemsize <= 4 * MAX_LETTERS:
        return array.item()
    raise ValueError(f"meta or digest is no text of {MAX_LETTERS} letters at most")


def digest(arrays: dict[str, np.ndarray]) -> str:
    """Returns the SHA-256 over the names, types, shapes and bytes of arrays, names sorted."""
    found = hashlib.sha256()
    for name, x in sorted(arrays.items()):
        found.update(f"{name} {x.dtype.str} {list(x.shape)}\n".encode())
        found.update(np.ascontiguousarray(x).reshape(-1).view(np.uint8))  # without a copy
    return found.hexdigest()


def act(policy: Policy, observation: np.ndarray, normal: Any = 0.0) -> np.ndarray:
    """Draws the action of each robot from the policy; without `normal` it is the most likely one.

    Args:
        policy: Of one learner for all robots, or of R or more.
        observation: [..., R, O] as `meta["observation"]` says: (quantity - offset) / scale.
        normal: [..., R, U] standard normal, drawn anew at each control step.

    Returns:
        [..., R, U] float32; -1..1 spans the commands, but it may lie beyond.
    """
    robots, learners = observation.shape[-2], len(policy.mean)
    if robots > learners and not policy.is_shared:
        raise PolicyError(f"{robots} robots are too many for {learners} independent policies.")
    mine, limit = slice(robots), policy.meta["observation"]["limit"]
    x = (observation.astype(np.float32) - policy.mean[mine]) / policy.std[mine]
    x = (policy.network or np.asarray)(np.clip(x, -limit, limit))
    *hidden, (kernel, bias) = policy.layers
    for weights, offset in hidden:
        x = _ACTIVATIONS[policy.meta["activation"]](np.vecmat(x, weights[mine]) + offset[mine])
    return np.vecmat(x, kernel[mine]) + bias[mine] + np.exp(policy.log_std[mine]) * normal


def command(policy: Policy, action: np.ndarray) -> np.ndarray:
    """Scales actions [..., U], clipped to -1..1, to commands.

    Returns:
        [..., U]: speed, 0..max_speed (m/s), and turn rate (rad/s, left positive).
    """
    speed, turn = np.moveaxis(np.clip(action, -1, 1), -1, 0)
    return np.stack([(speed + 1) * (0.5 * policy.max_speed), turn * policy.max_turn_rate], -1)
