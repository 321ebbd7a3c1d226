"""Reads and writes policy files (docs/policy-format.md). Needs no JAX.

`policy.py` reads the archive and checks the digest; `fields` checks what the archive holds.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax import extension, policy
from swarmjax.config import ConfigError
from swarmjax.config.reading import parse_json
from swarmjax.outputs import replacing
from swarmjax.policy import FORMAT, Policy, PolicyError
from swarmjax.policy_file.fields import NETWORK, check, short_json
from swarmjax.policy_network import PolicyNetwork


def read(path: str | Path, extensions: str | None = None) -> Policy:
    """Reads a policy file and checks all of it.

    Args:
      path: Path of the file.
      extensions: Value of the key `extensions`, for a policy whose network is code of an extension.

    Returns:
      The policy.

    Raises:
      PolicyError: The file is missing, damaged, of another format or inconsistent.
      ConfigError: The policy's network is not in `extensions`.
    """
    arrays, meta, digest = _read(Path(path))
    network = None
    if "network" in meta:
        pieces = extension.load(extensions)
        extension.check_needs(meta["extensions"], pieces, str(path), ["network"])
        own = {k.removeprefix(NETWORK): x for k, x in arrays.items() if k.startswith(NETWORK)}
        network = PolicyNetwork(str(extensions), meta["network"], own)
    return policy.assemble(arrays, meta, digest, network)


def read_meta(path: str | Path) -> dict[str, Any]:
    """Reads the description in a policy file, and checks the whole file.

    Args:
      path: Path of the file.

    Returns:
      The file's `meta`.

    Raises:
      PolicyError: The file is missing, damaged, of another format or inconsistent.
    """
    return _read(Path(path))[1]


def write(path: str | Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Writes a policy file, whole or not at all.

    Args:
      path: Path of the file; missing folders are made.
      arrays: All arrays of the format, by name, except `meta` and `digest`.
      meta: All keys of the format's `meta` except `format`, which is added.

    Raises:
      PolicyError: `read` would refuse the file, or the file cannot be written.
    """
    path, full = Path(path), {**meta, "format": FORMAT}
    _check(path, arrays, full)
    everything = {**arrays, "meta": np.array(json.dumps(full, sort_keys=True, allow_nan=False))}
    everything["digest"] = np.array(policy.digest(everything))
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **everything)
    except OSError as error:
        raise PolicyError(f"{path} cannot be written: {error.strerror or error}.") from None


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], str]:
    """Returns the arrays, `meta` and digest of a file, all of them checked."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "not a file"
        raise PolicyError(f"{path} is {what}: give the path of a policy.npz.")
    arrays, text, digest = policy.read(path)
    try:
        meta = parse_json(text, "meta")
    except ConfigError as error:
        raise PolicyError(f"{path}: {error}") from None
    if not isinstance(meta, dict):
        raise PolicyError(f"{path}: meta is {short_json(meta)}: expected a JSON object.")
    _check(path, arrays, meta)
    return arrays, meta, digest


def _check(path: Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Checks all fields, and puts the file's name in front of an error."""
    try:
        check(arrays, meta)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None
