"""Runs a trained `policy.npz` with NumPy alone: copy this one file (docs/policy-format.md)."""

import hashlib
import json
import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

FORMAT = 5
MAX_BYTES = 2**30  # limit for all arrays together; two layers of 64 take 20 kB
_MAX_LIST = 2**16  # limit for the archive's list of members, bytes; a member takes a hundred
MAX_LETTERS = 2**20  # limit for the characters of `meta`, which take four bytes each
MAX_ENTRIES = 2**16  # limit for the entries of `meta`, which take a hundred bytes or more each
MEMORY = ("input/kernel", "input/bias", "recurrent/kernel", "recurrent/bias")


class PolicyError(ValueError):
    """A refusal of a policy, in one sentence for the user."""


class Policy(NamedTuple):
    """A trained policy. L is 1 if all robots share one learner; otherwise robot i has learner i."""

    layers: list[tuple[np.ndarray, np.ndarray]]  # kernel [L, in, out] and bias [L, out]
    log_std: np.ndarray  # [L, U], logarithm of the standard deviation of the action
    mean: np.ndarray  # [L, O], mean of the observations
    std: np.ndarray  # [L, O], standard deviation of the observations
    is_shared: bool
    encoding: Any  # "metric" or "webots"
    max_speed: float  # m/s; the lowest speed is 0
    max_turn_rate: float  # rad/s, to the left and to the right
    meta: dict[str, Any]
    digest: str  # SHA-256 of the rest of the file, in hexadecimal
    network: Any = None  # only with `meta["network"]`: turns normalised [..., R, O] into features
    # only with `meta["memory"]`: input weights [L, F, 3 H] and their bias [L, 3 H], then recurrent
    # weights and their bias
    memory: tuple[np.ndarray, ...] | None = None

    @property
    def carried(self) -> int:
        """Count of numbers that a robot carries from one control step to the next."""
        return 0 if self.memory is None else self.memory[2].shape[1]


def load(path: str | Path | IO[bytes]) -> Policy:
    """Returns the policy in a file (path, or open in binary); raises PolicyError if invalid."""
    arrays, text, said = read(path)
    with _one_sentence(path):
        meta = json.loads(text)
        if meta["format"] != FORMAT:
            raise ValueError(f"meta.format is {json.dumps(meta['format'])[:80]}, not {FORMAT}")
        if "network" in meta:
            raise ValueError("its network is code of an extension")
        return assemble(arrays, meta, said)


@contextmanager
def _one_sentence(path: str | Path | IO[bytes]) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # zipfile, NumPy and json raise many errors for a damaged file
        reason = str(error).partition("\n")[0].rstrip(".") or type(error).__name__
        raise PolicyError(f"{path} cannot be read as a policy: {reason[:200]}.") from None


def read(path: str | Path | IO[bytes]) -> tuple[dict[str, np.ndarray], str, str]:
    """Returns a file's arrays, the JSON text of its `meta`, and its digest. Checks the digest."""
    with _one_sentence(path):
        if isinstance(path, str | Path) and Path(path).exists() and not Path(path).is_file():
            raise ValueError("it is not a regular file")  # reading a pipe would wait for its writer
        with open(path, "rb") if isinstance(path, str | Path) else nullcontext(path) as file:
            arrays = unpack(file)
        said, text = _text(arrays, "digest"), _text(arrays, "meta")
        if sum(map(text.count, "[{,:")) > MAX_ENTRIES:
            raise ValueError(f"meta has more than {MAX_ENTRIES} entries")
        del arrays["digest"]
        if said != digest(arrays):
            raise ValueError("its digest and its arrays do not match: it was changed or damaged")
        del arrays["meta"]
        return arrays, text, said


def assemble(
    arrays: dict[str, np.ndarray], meta: dict[str, Any], said: str, network: Any = None
) -> Policy:
    """Makes a policy from the arrays, `meta` and digest of a file, and an extension's network."""

    def layer(name: str) -> tuple[np.ndarray, np.ndarray]:
        return arrays[f"actor/{name}/kernel"], arrays[f"actor/{name}/bias"]

    hidden = sum(name.startswith("actor/hidden_") for name in arrays) // 2
    return Policy(
        layers=[*(layer(f"hidden_{i}") for i in range(hidden)), layer("mean")],
        log_std=arrays["actor/log_std"],
        mean=arrays["normalizer/mean"],
        std=arrays["normalizer/std"],
        is_shared=meta["policy"] == "shared",
        encoding=meta["observation"]["encoding"],
        max_speed=meta["action"]["high"][0],
        max_turn_rate=meta["action"]["high"][1],
        meta=meta,
        digest=said,
        network=network,
        memory=tuple(arrays[f"actor/memory/{n}"] for n in MEMORY) if "memory" in meta else None,
    )


def unpack(file: IO[bytes]) -> dict[str, np.ndarray]:
    """Reads the arrays of an archive. Refuses a file that unpacks to more bytes than it has."""
    file.seek(max(0, file.seek(0, 2) - 42))
    end = file.read()
    if end[-22:-18] != b"PK\5\6":
        raise zipfile.BadZipFile("File is not a zip file")
    if end[:4] == b"PK\6\7" or int.from_bytes(end[-10:-6], "little") > _MAX_LIST:
        raise ValueError(f"its list of members has more than {_MAX_LIST} bytes")
    with zipfile.ZipFile(file) as archive:  # reads the whole list
        members, size = archive.infolist(), file.seek(0, 2)
        if size > MAX_BYTES or sum(member.file_size for member in members) > size:
            raise ValueError(f"it unpacks to more than its size, or to over {MAX_BYTES} bytes")
        plain = {x.filename for x in members if not (x.compress_type or x.flag_bits & 1)}
        if len(plain) < len(members) or not all(name.endswith(".npy") for name in plain):
            raise ValueError("a member is compressed, encrypted, duplicated or no .npy file")
        return {x.filename.removesuffix(".npy"): read_array(archive, x) for x in members}


def read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Reads the array in a member, and checks that the member's size matches the array's header."""
    with archive.open(member) as file:
        try:
            version = np.lib.format.read_magic(file)
            shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
            size = file.tell() + math.prod(shape) * dtype.itemsize
            is_plain = version == (1, 0) and dtype.kind in "biufU" and not is_fortran
            if not is_plain or size != member.file_size:
                raise ValueError
            return np.frombuffer(file.read(), dtype).reshape(shape)
        except ValueError:  # NumPy raises it too, for a damaged header
            raise ValueError(f"{member.filename!r} does not match its header") from None


def _text(arrays: dict[str, np.ndarray], name: str) -> str:
    array = arrays.get(name, np.empty(0))
    if array.dtype.str[:2] == "<U" and not array.shape and array.itemsize <= 4 * MAX_LETTERS:
        return str(array.tobytes(), "utf-32-le").rstrip("\0")
    raise ValueError(f"{name} is not a text of at most {MAX_LETTERS} characters")


def digest(arrays: dict[str, np.ndarray]) -> str:
    """Returns the SHA-256 over the names, types, shapes and bytes of arrays, sorted by name."""
    sha = hashlib.sha256()
    for name, x in sorted(arrays.items()):
        sha.update(f"{name} {x.dtype.str} {list(x.shape)}\n".encode())
        sha.update(np.ascontiguousarray(x).reshape(-1).view(np.uint8))  # without a copy
    return sha.hexdigest()


def act(policy: Policy, observation: np.ndarray, normal: Any = 0.0) -> np.ndarray:
    """Samples the action of each robot. Without `normal`, returns the most likely action.

    Args:
      policy: A policy without memory, with one learner for all robots or at least R learners.
      observation: [..., R, O] as `meta["observation"]` says: (quantity - offset) / scale.
      normal: [..., R, U] standard normal numbers, drawn afresh at each control step.

    Returns:
      [..., R, U] float32. -1..1 spans the range of commands, but actions may lie beyond it.
    """
    if policy.carried:
        raise PolicyError("the policy has a memory: use `begin` and `step` in place of `act`.")
    return step(policy, None, observation, normal)[1]


def begin(policy: Policy, shape: tuple[int, ...]) -> np.ndarray | None:
    """Returns the memory [*shape, H] for the start of an episode; None if the policy has none."""
    return np.zeros((*shape, policy.carried), "f4") if policy.carried else None


def step(
    policy: Policy, memory: Any, observation: Any, normal: Any = 0.0, xp: Any = np
) -> tuple[Any, Any]:
    """Samples actions as `act` does; returns the memory after this step, and the actions.

    Args:
      policy: As in `act`, but with or without a memory.
      memory: [..., R, H] from `begin` or from the previous call.
      observation, normal: As in `act`.
      xp: `numpy`, or `jax.numpy` if the policy and the observations have JAX arrays.
    """
    _check(policy, memory, observation)
    mine, limit = slice(observation.shape[-2]), policy.meta["observation"]["limit"]
    x = (observation.astype(np.float32) - policy.mean[mine]) / policy.std[mine]
    x = xp.clip(x, -limit, limit)
    if policy.network is not None:
        x = policy.network(x)
    *hidden, (kernel, bias) = policy.layers
    for weights, offset in hidden:
        x = _activate(policy, xp.vecmat(x, weights[mine]) + offset[mine], xp)
    if policy.memory is not None:
        memory = _remember([part[mine] for part in policy.memory], memory, x, xp)
        x = xp.concatenate([x, memory], axis=-1)
    mean = xp.vecmat(x, kernel[mine]) + bias[mine]
    return memory, mean + xp.exp(policy.log_std[mine]) * normal


def _activate(policy: Policy, x: Any, xp: Any) -> Any:
    kind = policy.meta["activation"]
    if kind == "swish":
        return 0.5 * x * (1 + xp.tanh(0.5 * x))  # x * logistic(x), without overflow
    return xp.tanh(x) if kind == "tanh" else xp.maximum(x, 0)


def _check(policy: Policy, memory: Any, observation: Any) -> None:
    """Refuses arguments of `step` with wrong shapes."""
    if len(getattr(observation, "shape", ())) < 2:
        raise PolicyError("observation has no axis of robots: give an array [..., R, O].")
    robots, (learners, size) = observation.shape[-2], policy.mean.shape
    if robots > learners and not policy.is_shared:
        raise PolicyError(f"{robots} robots are too many: the policy has {learners} networks.")
    if observation.shape[-1] != size:
        raise PolicyError(f"observation has {observation.shape[-1]} entries: give {size}.")
    expected = begin(policy, observation.shape[:-1])
    if getattr(memory, "shape", None) != getattr(expected, "shape", None):
        given, wanted = ("none" if x is None else list(np.shape(x)) for x in (memory, expected))
        raise PolicyError(f"memory is {given}: give {wanted}, as `begin` returns it.")


def _remember(parts: list[Any], memory: Any, features: Any, xp: Any) -> Any:
    """Updates the memory with a gated recurrent unit (GRU).

    The reset gate multiplies the product of memory and recurrent weights, not the memory itself.
    """

    def logistic(x: Any) -> Any:
        return 0.5 + 0.5 * xp.tanh(0.5 * x)  # 1 / (1 + exp(-x)), without overflow

    seen = xp.vecmat(features, parts[0]) + parts[1]
    recalled = xp.vecmat(memory, parts[2]) + parts[3]
    (r, z, fresh), (r_, z_, old) = xp.split(seen, 3, -1), xp.split(recalled, 3, -1)
    fresh = xp.tanh(fresh + logistic(r + r_) * old)
    return fresh + logistic(z + z_) * (memory - fresh)


def command(policy: Policy, action: np.ndarray) -> np.ndarray:
    """Scales actions [..., U], clipped to -1..1, to commands.

    Returns:
      [..., U]: speed, 0..max_speed (m/s), and turn rate (rad/s, left positive).
    """
    speed, turn = np.moveaxis(np.clip(action, -1, 1), -1, 0)
    return np.stack([(speed + 1) * (0.5 * policy.max_speed), turn * policy.max_turn_rate], -1)
