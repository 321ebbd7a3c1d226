"""A campaign of `benchmarks.faults` that damages policy files and tests both readers (`READERS`).

The campaign records which files each reader accepts, and how much time and memory each reader
takes. NumPy also reads each accepted file, and a separate function computes the file's digest. If
this digest differs from the digest in the file, the outcome is WRONG. The memory of a reader is the
peak that Python and NumPy allocate while the reader works.
"""

import hashlib
import io
import json
import random
import time
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import baselines
from swarmjax import policy, policy_file
from swarmjax.policy import PolicyError
from swarmjax.task import observation

MOST_SECONDS = 1.0
MOST_TIMES = 4  # memory limit, as a multiple of the file's size
LEAST_LIMIT = 2**24  # bytes; this much memory is always allowed
Readers = dict[str, Callable[[Path], Any]]
READERS: Readers = {"load": policy.load, "read": policy_file.read}
_SIZES = ((64, 64), (8,), (700, 500))
_BIAS = "actor/hidden_0/bias.npy"


def write_sound(path: Path, draw: random.Random) -> None:
    """Writes a valid policy, shared or independent, small or larger than a megabyte.

    Args:
      path: path of the file.
      draw: random source for the policy's size and numbers.
    """
    learners, hidden = draw.choice((1, 1, 5)), draw.choice(_SIZES)
    numbers = np.random.default_rng(draw.randrange(2**32))
    sizes = (observation.SIZE, *hidden, 2)
    names = [*(f"hidden_{i}" for i in range(len(hidden))), "mean"]
    arrays = {}
    for name, inner, outer in zip(names, sizes, sizes[1:], strict=False):
        arrays[f"actor/{name}/kernel"] = numbers.normal(size=(learners, inner, outer))
        arrays[f"actor/{name}/bias"] = numbers.normal(size=(learners, outer))
    arrays["actor/log_std"] = numbers.normal(size=(learners, 2))
    arrays["normalizer/mean"] = numbers.normal(size=(learners, observation.SIZE))
    arrays["normalizer/std"] = numbers.uniform(0.5, 2, (learners, observation.SIZE))
    floats = {name: array.astype(np.float32) for name, array in arrays.items()}
    policy_file.write(path, floats, baselines.meta(learners, "tanh"))


# Kinds of damage: each function takes the content of a file and returns the damaged content


def _flip(content: bytes, draw: random.Random) -> bytes:
    found = bytearray(content)
    for _ in range(draw.choice((1, 1, 3, 30))):
        found[draw.randrange(len(found))] ^= 1 << draw.randrange(8)
    return bytes(found)


def _cut(content: bytes, draw: random.Random) -> bytes:
    first, last = sorted(draw.randrange(len(content) + 1) for _ in range(2))
    return draw.choice((content[:first], content[last:], content[:first] + content[last:]))


def _overwrite(content: bytes, draw: random.Random) -> bytes:
    start, size = draw.randrange(len(content)), draw.randrange(1, 5000)
    junk = draw.choice((bytes(size), b"\xff" * size, draw.randbytes(size)))
    return content[:start] + junk + content[start + size :]


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _pack(members: list[tuple[str, bytes]], packing: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(file, "w", packing) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return file.getvalue()


def _lose(content: bytes, draw: random.Random) -> bytes:
    members = _members(content)
    for _ in range(draw.choice((1, 1, 2))):
        del members[draw.choice(sorted(members))]
    return _pack([*members.items()])


def _swap(content: bytes, draw: random.Random) -> bytes:
    members = _members(content)
    first, second = draw.sample(sorted(members), 2)
    members[first], members[second] = members[second], members[first]
    return _pack([*members.items()])


def _double(content: bytes, draw: random.Random) -> bytes:
    members = [*_members(content).items()]
    return _pack([*members, draw.choice(members)])


def npy(dtype: str, shape: str) -> bytes:
    """Returns the header of an array file, without the array's data.

    Args:
      dtype: type of the numbers, as NumPy writes it.
      shape: shape, as NumPy writes it, without brackets.
    """
    head = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({shape}), }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode()


def _forge_header(content: bytes, draw: random.Random) -> bytes:
    shape = draw.choice(("2147483648,", "99999, 99999", "-1,", "0, 2", "9" * 30 + ",", "-2, -3"))
    dtype = draw.choice(("<f4", "<f8", "|O", "<U0", "<U99999999", "|V0", "<M8", "|S1"))
    members = _members(content)
    members[draw.choice(sorted(members))] = npy(dtype, shape) + draw.randbytes(draw.randrange(99))
    return _pack([*members.items()])


def _bomb(content: bytes, draw: random.Random) -> bytes:
    """Adds up to 256 MB of compressed zeros, or claims that a member is this large."""
    size = draw.choice((2**20, 2**24, 2**28))
    if draw.random() < 0.5:
        data = npy("<f4", f"{size // 4},") + bytes(size)
        return _pack([*_members(content).items(), (_BIAS, data)], zipfile.ZIP_DEFLATED)
    found, entry = bytearray(content), content.index(b"PK\x01\x02")
    for at in draw.choice(((24,), (20, 24))):  # offsets of the sizes in the list of members
        found[entry + at : entry + at + 4] = size.to_bytes(4, "little")
    return bytes(found)


def _crowd(content: bytes, draw: random.Random) -> bytes:
    extra = [(f"{i}.npy", b"") for i in range(draw.choice((100, 1000, 20_000)))]
    return _pack([*_members(content).items(), *extra])


def _encrypt(content: bytes, draw: random.Random) -> bytes:
    found = bytearray(content)
    entry = content.index(b"PK\x01\x02")
    found[entry + 8 + draw.randrange(2)] |= 1 << draw.randrange(8)
    return bytes(found)


def _say(content: bytes, draw: random.Random) -> bytes:
    """Changes the file's metadata, and writes a correct or an incorrect digest."""
    arrays = arrays_of(content)
    said = json.loads(str(arrays["meta"]))
    key = draw.choice(sorted(said))
    said[key] = draw.choice((None, 10**400, -1, 1e39, [], {}, "\0", [[]] * 9, {"a": {}}, "x" * 999))
    text = draw.choice(
        (
            json.dumps(said),
            json.dumps(said),
            "[" * draw.choice((33, 999, 50_000, 200_000)),
            '{"a":' * 20_000 + "1" + "}" * 20_000,
            '{"format": ' + "9" * 5000 + "}",
            "[" + "{}," * 60_000 + "{}]",
            "[" + ",".join(f'{{"{i}":{{}}}}' for i in range(16_000)) + "]",
            "\U0001f600" * draw.choice((10, 10**6)),
        )
    )
    return _with_digest(arrays | {"meta": np.array(text)}, draw)


def _foreign_digest(content: bytes, draw: random.Random) -> bytes:
    arrays = arrays_of(content)
    wrong = draw.choice(("0" * 64, "", "x" * 10**6, hashlib.sha256(b"other").hexdigest()))
    arrays["digest"] = draw.choice((np.array(wrong), np.zeros(3), np.array([wrong])))
    return _savez(arrays)


def _other_array(content: bytes, draw: random.Random) -> bytes:
    """Replaces an array with another array, and mostly corrects the digest."""
    arrays = arrays_of(content)
    name = draw.choice(sorted(arrays.keys() - {"digest", "meta"}))
    array = arrays[name]
    arrays[name] = draw.choice(
        (array * np.nan, array.astype(np.float64), array[..., :1], array.T, array[None], array + 1)
    )
    return _with_digest(arrays, draw)


def arrays_of(content: bytes) -> dict[str, np.ndarray]:
    """Returns the arrays in the content of a policy file, by name."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return dict(archive)


def _savez(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _with_digest(arrays: dict[str, np.ndarray], draw: random.Random) -> bytes:
    rest = {name: array for name, array in arrays.items() if name != "digest"}
    digest = digest_of(rest) if draw.random() < 0.9 else "0" * 64
    return _savez(rest | {"digest": np.array(digest)})


DAMAGE: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "flip": _flip,
    "cut": _cut,
    "overwrite": _overwrite,
    "lose": _lose,
    "swap": _swap,
    "double": _double,
    "header": _forge_header,
    "bomb": _bomb,
    "crowd": _crowd,
    "encrypt": _encrypt,
    "say": _say,
    "digest": _foreign_digest,
    "array": _other_array,
}


# Outcomes


def digest_of(arrays: dict[str, np.ndarray]) -> str:
    """Computes the digest exactly as docs/policy-format.md describes."""
    found = b""
    for name in sorted(arrays):
        array = arrays[name]
        found += f"{name} {array.dtype.str} {list(array.shape)}\n".encode() + array.tobytes()
    return hashlib.sha256(found).hexdigest()


def _is_right(path: Path) -> bool:
    """Tells whether the digest in a file matches its arrays, as NumPy reads them."""
    arrays = arrays_of(path.read_bytes())
    return str(arrays.pop("digest")) == digest_of(arrays)


def is_sentence(text: str) -> bool:
    """Tells whether a refusal is one short printable line that ends like a sentence.

    Args:
      text: text of the refusal.
    """
    return "\n" not in text and text.isprintable() and text[-1:] in (".", "?") and len(text) < 900


class _Tried(NamedTuple):
    """The result of reading a file: outcome, message, seconds, and peak memory in bytes."""

    outcome: str
    said: str
    seconds: float
    peak: int


def _try(read: Callable[[Path], Any], path: Path) -> _Tried:
    """Reads a file, and measures the seconds and the peak memory."""
    said = ""
    tracemalloc.start()
    began = time.perf_counter()
    try:
        read(path)
        outcome = "accepted"
    except PolicyError as error:
        said = str(error)
        outcome = "refused" if is_sentence(said) else "NO SENTENCE"
    except Exception as error:
        said = repr(error)[:300]
        outcome = "TRACEBACK"
    seconds, peak = time.perf_counter() - began, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    if outcome == "accepted" and not _is_right(path):
        outcome = "WRONG"
    return _Tried(outcome, said, seconds, peak)


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Damages a policy file in one way and has both readers read the file.

    Args:
      seed: seed of the damage.
      folder: folder for the file.

    Returns:
      The entries of the line; the outcome is `accepted` if either reader accepted the file.
    """
    draw, path = random.Random(seed), folder / "policy.npz"
    write_sound(path, draw)
    kind = draw.choice(sorted(DAMAGE))
    path.write_bytes(DAMAGE[kind](path.read_bytes(), draw))
    size = path.stat().st_size
    found = {name: _try(read, path) for name, read in READERS.items()}
    outcomes = [each.outcome for each in found.values()]
    bad = [each for each in outcomes if each not in ("accepted", "refused")]
    peak = max(each.peak for each in found.values())
    seconds = max(each.seconds for each in found.values())
    if peak > max(MOST_TIMES * size, LEAST_LIMIT):
        bad.append("TOO MUCH MEMORY")
    if seconds > MOST_SECONDS:
        bad.append("SLOW")
    return {
        "outcome": bad[0] if bad else "accepted" if "accepted" in outcomes else "refused",
        "damage": kind,
        **{name: each.outcome for name, each in found.items()},
        "said": {name: each.said[-200:] for name, each in found.items()},
        "bytes": size,
        "peak": peak,
        "times_of_large": round(peak / size, 2) if size > LEAST_LIMIT // MOST_TIMES else 0.0,
        "seconds": round(seconds, 4),
    }
