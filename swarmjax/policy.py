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
MEMORY_FORMAT = 4  # for a policy with a memory or a history
HEARING_FORMAT = 5  # for a policy that hears neighbours, with or without memory
MAX_BYTES = 2**30  # limit for all arrays; with two layers of 64 they take 20 kB
_MAX_LIST = 2**16  # bytes of the list of members; a name takes a hundred
MAX_LETTERS = 2**20  # characters of `meta`, four bytes each
MAX_ENTRIES = 2**16  # entries of `meta`, each a hundred bytes or more
MEMORY = ("input/kernel", "input/bias", "recurrent/kernel", "recurrent/bias")
_ACTIVATIONS = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "swish": lambda x: 0.5 * x * (1 + np.tanh(0.5 * x)),  # x * logistic(x), without overflow
}


class PolicyError(ValueError):
    """A refusal of a policy, in one sentence for the user."""


class Policy(NamedTuple):
    """A trained policy. L is 1 if all robots share one learner; otherwise robot i is learner i."""

    layers: list[tuple[np.ndarray, np.ndarray]]  # kernel [L, in, out] and bias [L, out]
    log_std: np.ndarray  # [L, U], logarithm of the deviation of the action
    mean: np.ndarray  # [L, k O], mean of the observations, newest first; k is `history`
    std: np.ndarray  # [L, k O], their deviation
    is_shared: bool
    encoding: Any  # "metric" or "webots"
    max_speed: float  # m/s; commands begin at 0
    max_turn_rate: float  # rad/s, to either side
    meta: dict[str, Any]
    digest: str  # SHA-256 of the rest of the file, in hexadecimal
    network: Any = None  # with `meta["network"]`: normalised [..., R, k O] to features
    # format 4: input weights [L, F, 3 H] and bias [L, 3 H], recurrent weights and bias
    memory: tuple[np.ndarray, ...] | None = None
    # format 5: kernel [L, W, E] and bias [L, E] of the layer for neighbours
    hearing: tuple[np.ndarray, ...] | None = None

    @property
    def neighbours(self) -> dict[str, Any]:
        """Neighbour settings: `count`, `range` (m) and `message_size`; empty if not used."""
        return self.meta["observation"].get("neighbours", {})

    @property
    def history(self) -> int:
        """Number of observations that the policy uses: the last one, and earlier ones."""
        return self.meta["observation"].get("history", 1)

    @property
    def carried(self) -> int:
        """Count of numbers that a robot carries from one control step to the next."""
        if self.memory is not None:
            return self.memory[2].shape[1]
        return (self.history - 1) * (self.mean.shape[1] // self.history)


def load(path: str | Path | IO[bytes]) -> Policy:
    """Returns the policy in a file (path, or open in binary); raises PolicyError if invalid."""
    try:
        if isinstance(path, str | Path) and Path(path).exists() and not Path(path).is_file():
            raise ValueError("it is not a plain file")  # reading a pipe would wait for its writer
        with open(path, "rb") if isinstance(path, str | Path) else nullcontext(path) as file:
            arrays = _read(file)
        found, text = _text(arrays.pop("digest")), _text(arrays["meta"])
        if sum(map(text.count, "[{,:")) > MAX_ENTRIES:
            raise ValueError(f"meta has more than {MAX_ENTRIES} entries")
        meta = json.loads(text)
        seen = meta.get("observation", {})
        history = seen.get("history", 1)
        if type(history) is not int or history < 1:
            raise ValueError(f"meta.observation.history is {json.dumps(history)[:80]}")
        hears = "neighbours" in seen
        wanted = MEMORY_FORMAT if "memory" in meta or history > 1 else FORMAT
        wanted = HEARING_FORMAT if hears else wanted
        if meta["format"] in (MEMORY_FORMAT, HEARING_FORMAT) and "network" in meta:
            raise ValueError("its network is code of an extension")
        if meta["format"] != wanted:
            raise ValueError(f"meta.format is {json.dumps(meta['format'])[:80]}, not {wanted}")
        if found != digest(arrays):
            raise ValueError("digest is not that of the arrays")
        memory = (
            tuple(arrays.pop(f"actor/memory/{n}") for n in MEMORY) if "memory" in meta else None
        )
        parts = ("kernel", "bias")
        hearing = tuple(arrays.pop(f"actor/hearing/{n}") for n in parts) if hears else None
        names = [*(f"hidden_{i}" for i in range((len(arrays) - 6) // 2)), "mean"]
        layers = [(arrays[f"actor/{n}/kernel"], arrays[f"actor/{n}/bias"]) for n in names]
        rest = [arrays[n] for n in ("actor/log_std", "normalizer/mean", "normalizer/std")]
        rest += [meta["policy"] == "shared", meta["observation"]["encoding"]]
        rest += [*meta["action"]["high"][:2], meta, found]
        return Policy(*[layers, *rest], memory=memory, hearing=hearing)
    except Exception as error:  # zipfile, NumPy and json raise many errors for a damaged file
        reason = str(error).partition("\n")[0].rstrip(".") or type(error).__name__
        raise PolicyError(f"{path} cannot be read as a policy: {reason[:200]}.") from None


def open_archive(file: IO[bytes]) -> zipfile.ZipFile:
    """Opens an archive; first checks the size of its list of members, which zipfile reads."""
    file.seek(max(0, file.seek(0, 2) - 42))
    end = file.read()
    if end[-22:-18] != b"PK\5\6":
        raise zipfile.BadZipFile("File is not a zip file")
    if end[:4] == b"PK\6\7" or int.from_bytes(end[-10:-6], "little") > _MAX_LIST:
        raise ValueError(f"its list of members has more than {_MAX_LIST} bytes")
    return zipfile.ZipFile(file)


def _read(file: IO[bytes]) -> dict[str, np.ndarray]:
    """Reads the arrays of an archive; refuses one that unpacks to more bytes than the file has."""
    with open_archive(file) as archive:
        members, size = archive.infolist(), file.seek(0, 2)
        if size > MAX_BYTES or sum(member.file_size for member in members) > size:
            raise ValueError(f"it unpacks to more than the file, or {MAX_BYTES} bytes")
        plain = {x.filename for x in members if not (x.compress_type or x.flag_bits & 1)}
        if len(plain) < len(members):
            raise ValueError("a member is compressed, encrypted or duplicated")
        return {x.filename.removesuffix(".npy"): read_array(archive, x) for x in members}


def read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Reads a member, and checks that its size matches its header."""
    with archive.open(member) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError(f"{member.filename!r} is not of npy version 1.0")
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
        size = file.tell() + math.prod(shape) * dtype.itemsize
        if dtype.hasobject or is_fortran or size != member.file_size:
            raise ValueError(f"{member.filename!r} does not match its header")
        return np.frombuffer(file.read(), dtype).reshape(shape)


def _text(array: np.ndarray) -> str:
    if array.dtype.kind == "U" and not array.shape and array.itemsize <= 4 * MAX_LETTERS:
        return array.item()
    raise ValueError(f"meta or digest is not a text of at most {MAX_LETTERS} characters")


def digest(arrays: dict[str, np.ndarray]) -> str:
    """Returns the SHA-256 over the names, types, shapes and bytes of arrays, sorted by name."""
    found = hashlib.sha256()
    for name, x in sorted(arrays.items()):
        found.update(f"{name} {x.dtype.str} {list(x.shape)}\n".encode())
        found.update(np.ascontiguousarray(x).reshape(-1).view(np.uint8))  # without a copy
    return found.hexdigest()


def act(policy: Policy, observation: np.ndarray, normal: Any = 0.0) -> np.ndarray:
    """Draws the action of each robot; without `normal` it is the most likely one.

    Args:
      policy: Has no memory and no history. It has one learner for all robots, or at least R
        learners.
      observation: [..., R, O] as `meta["observation"]` says: (quantity - offset) / scale.
      normal: [..., R, U] standard normal, drawn afresh at each control step.

    Returns:
      [..., R, U] float32. -1..1 spans the commands, but actions may lie beyond it.
    """
    if policy.carried:
        raise PolicyError("the policy has a memory: call `begin` once an episode, then `step`.")
    return step(policy, None, observation, normal)[1]


def begin(policy: Policy, shape: tuple[int, ...]) -> np.ndarray | None:
    """Returns the memory of robots whose episode begins; None if there is none.

    The memory is [*shape, H]. With a history it is the earlier observations, [*shape, (k - 1) O].
    """
    return np.zeros((*shape, policy.carried), "f4") if policy.carried else None


def step(
    policy: Policy, memory: np.ndarray | None, observation: np.ndarray, normal: Any = 0.0
) -> tuple[np.ndarray | None, np.ndarray]:
    """Draws actions as `act` does, and updates the memory.

    Args:
      policy: Has one learner for all robots, or at least R learners.
      memory: [..., R, H] from `begin` or from the step before.
      observation: As in `act`; even with a history, only that of this control step.
      normal: As in `act`.

    Returns:
      The memory after this step, and the action.
    """
    _check(policy, memory, observation)
    mine, limit = slice(observation.shape[-2]), policy.meta["observation"]["limit"]
    x = observation.astype(np.float32)
    if policy.history > 1 and memory is not None:
        x = np.concatenate([x, memory], axis=-1)
        memory = x[..., : policy.carried]
    x = (x - policy.mean[mine]) / policy.std[mine]
    x = (policy.network or np.asarray)(np.clip(x, -limit, limit))
    if policy.hearing is not None:
        x = _hear([part[mine] for part in policy.hearing], policy, x)
    *hidden, (kernel, bias) = policy.layers
    for weights, offset in hidden:
        x = _ACTIVATIONS[policy.meta["activation"]](np.vecmat(x, weights[mine]) + offset[mine])
    if policy.memory is not None and memory is not None:
        memory = _remember([part[mine] for part in policy.memory], memory, x)
        x = np.concatenate([x, memory], axis=-1)
    mean = np.vecmat(x, kernel[mine]) + bias[mine]
    return memory, mean + np.exp(policy.log_std[mine]) * normal


def _check(policy: Policy, memory: np.ndarray | None, observation: np.ndarray) -> None:
    """Refuses arguments of `step` with wrong shapes."""
    robots, learners = observation.shape[-2], len(policy.mean)
    if robots > learners and not policy.is_shared:
        raise PolicyError(f"{robots} robots are too many for {learners} independent policies.")
    size = policy.mean.shape[1] // policy.history
    if observation.shape[-1] != size:
        raise PolicyError(f"observation has {observation.shape[-1]} entries: give {size}.")
    expected = begin(policy, observation.shape[:-1])
    if getattr(memory, "shape", None) != getattr(expected, "shape", None):
        found = "none" if memory is None else list(np.shape(memory))
        wanted = "none" if expected is None else list(expected.shape)
        raise PolicyError(f"memory is {found}: give {wanted}, as `begin` returns it.")


def _hear(parts: list[np.ndarray], policy: Policy, x: np.ndarray) -> np.ndarray:
    """Returns the observation with its neighbours replaced by the sum of one layer over them."""
    (kernel, bias), count = parts, policy.neighbours["count"]
    first = x.shape[-1] - count * kernel.shape[1]
    rows = x[..., first:].reshape(*x.shape[:-1], count, kernel.shape[1])
    each = _ACTIVATIONS[policy.meta["activation"]](np.matmul(rows, kernel) + bias[:, None])
    return np.concatenate([x[..., :first], (each * rows[..., :1]).sum(-2)], axis=-1)


def _remember(parts: list[np.ndarray], memory: np.ndarray, features: np.ndarray) -> np.ndarray:
    """Updates the memory with a gated recurrent unit (GRU) whose reset gate follows the product."""
    seen, recalled = (
        np.vecmat(features, parts[0]) + parts[1],
        np.vecmat(memory, parts[2]) + parts[3],
    )
    (r, z, fresh), (r_, z_, old) = np.split(seen, 3, -1), np.split(recalled, 3, -1)
    fresh = np.tanh(fresh + _logistic(r + r_) * old)
    return fresh + _logistic(z + z_) * (memory - fresh)


def _logistic(x: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.tanh(0.5 * x)  # 1 / (1 + exp(-x)), without overflow


def command(policy: Policy, action: np.ndarray) -> np.ndarray:
    """Scales actions [..., U], clipped to -1..1, to commands.

    Returns:
      [..., U]: speed, 0..max_speed (m/s), and turn rate (rad/s, left positive). If robots send
      messages, these follow, within -1..1.
    """
    speed, turn, *said = np.moveaxis(np.clip(action, -1, 1), -1, 0)
    drive = [(speed + 1) * (0.5 * policy.max_speed), turn * policy.max_turn_rate]
    return np.stack([*drive, *said], -1)
