"""Runs a trained `policy.npz` with NumPy alone: copy this one file (docs/policy-format.md)."""

import hashlib
import json
import zipfile
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

FORMAT = 2
MAX_BYTES = 2**30  # of all arrays; those of two layers of 64 take 20 kB
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
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise ValueError(f"it unpacks to more than {MAX_BYTES} bytes")
            members = {name.removesuffix(".npy"): archive.open(name) for name in archive.namelist()}
            arrays = {name: np.lib.format.read_array(file) for name, file in members.items()}
        found, meta = str(arrays.pop("digest")), json.loads(str(arrays["meta"]))
        if meta["format"] != FORMAT:
            raise ValueError(f"meta.format is {meta['format']}, and {FORMAT} is what is read")
        if found != digest(arrays):
            raise ValueError("digest is not that of the arrays")
        names = [*(f"hidden_{i}" for i in range((len(arrays) - 6) // 2)), "mean"]
        layers = [(arrays[f"actor/{n}/kernel"], arrays[f"actor/{n}/bias"]) for n in names]
        rest = [arrays[n] for n in ("actor/log_std", "normalizer/mean", "normalizer/std")]
        rest += [meta["policy"] == "shared", meta["observation"]["encoding"]]
        return Policy(*[layers, *rest, *meta["action"]["high"], meta, found])
    except Exception as error:  # whatever a damaged file makes zipfile, NumPy and json raise
        reason = str(error).partition("\n")[0].rstrip(".") or type(error).__name__
        raise PolicyError(f"{path} cannot be read as a policy: {reason}.") from None


def digest(arrays: dict[str, np.ndarray]) -> str:
    """Returns the SHA-256 over the names, types, shapes and bytes of arrays, names sorted."""
    heads = {name: f"{name} {x.dtype.str} {list(x.shape)}\n".encode() for name, x in arrays.items()}
    rows = (heads[name] + arrays[name].tobytes() for name in sorted(arrays))
    return hashlib.sha256(b"".join(rows)).hexdigest()


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
