"""Reads and writes policy files (docs/policy-format.md). No JAX.

`policy.load` trusts NumPy's reading of a file; `read` trusts nothing. It does not evaluate a
member's header, but matches it against the one form that NumPy writes. It compares sizes before it
allocates anything. `fields` checks what a file holds.
"""

import io
import json
import math
import re
import zipfile
from collections.abc import Callable, Mapping, Set
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax import extension, policy
from swarmjax.config import ConfigError
from swarmjax.config.reading import parse_json
from swarmjax.outputs import replacing
from swarmjax.policy import FORMAT, MAX_BYTES, MAX_ENTRIES, MAX_LETTERS, Policy, PolicyError
from swarmjax.policy_file.fields import NETWORK, check, file_format, hidden_layers, short_json
from swarmjax.policy_network import PolicyNetwork

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
_MOST_HEADER = 10_000  # bytes, with all that precedes the header; NumPy reads no longer headers
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
    depth = hidden_layers(members, own=True)
    names = [*(f"hidden_{i}" for i in range(depth)), "mean"]
    arrays = {
        name.removeprefix(NETWORK): array
        for name, array in members.items()
        if name.startswith(NETWORK)
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
    full = {**meta, "format": file_format(meta)}
    _refuse_in(path, lambda: check(arrays, full))
    everything = {**arrays, "meta": np.array(json.dumps(full, sort_keys=True, allow_nan=False))}
    everything["digest"] = np.array(policy.digest(everything))
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **everything)
    except OSError as error:
        raise PolicyError(f"{path} cannot be written: {error.strerror or error}.") from None


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
            f"digest is {short_json(expected[:12])}..., but the content has digest "
            f"{short_json(found[:12])}...: the file was changed or damaged."
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
        raise PolicyError(f"{short_json(name)} is not known: format {FORMAT} has no such member.")
    if name in found:
        raise PolicyError(f"{short_json(name)} appears more than once: expected each member once.")
    if member.flag_bits & 1 or member.compress_type != zipfile.ZIP_STORED:
        raise PolicyError(
            f"{short_json(name)} is compressed or encrypted: expected stored members."
        )


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
        raise PolicyError(f"meta is {short_json(meta)}: expected a JSON object.")
    return meta


def _plain(text: str) -> str:
    """Removes control characters from text."""
    return text.encode("unicode_escape").decode("ascii")
