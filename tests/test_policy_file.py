"""Tests the policy file: a written policy reads back, and what is unsound is refused by name."""

import contextlib
import io
import itertools
import json
import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import policies
import pytest
from policies import Arrays, forge, saved, several

from swarmjax import command, policy, policy_file
from swarmjax.config import ConfigError
from swarmjax.evaluate import __main__ as evaluate_command
from swarmjax.evaluate import trained_settings
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.exit_codes import USER_ERROR
from swarmjax.export import __main__ as export
from swarmjax.export.config import ExportConfig
from swarmjax.policy import FORMAT, PolicyError
from swarmjax.policy_file import fields
from swarmjax.run.load_settings import load_train
from swarmjax.run.policy_export import policy_meta
from swarmjax.task.observation import SIZE


def _f32(values: Any) -> np.ndarray:
    return np.array(values, np.float32)


def _said(**changes: Any) -> dict[str, Any]:
    return {"format": FORMAT} | policies.meta(**changes)


def test_a_written_policy_comes_back_bit_for_bit(tmp_path: Path) -> None:
    arrays = policies.arrays(learners=3)
    path = tmp_path / "new" / "policy.npz"
    policy_file.write(path, arrays, policies.meta(**several(3)))
    with np.load(path, allow_pickle=False) as archive:
        found = dict(archive)
    assert str(found.pop("digest")) == policy.digest(found) == policy_file.read(path).digest
    assert json.loads(str(found.pop("meta"))) == _said(**several(3))
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
    assert policy_file.read(path).meta == _said(**several(3))


def test_a_crash_while_writing_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "policy.npz"
    before = saved(path)

    def crash(file: Any, **_: Any) -> None:
        file.write(b"half a file")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", crash)
    with pytest.raises(KeyboardInterrupt):
        policy_file.write(path, policies.arrays(seed=1), policies.meta())
    assert policy_file.read(path).digest == before.digest
    assert [found.name for found in tmp_path.iterdir()] == ["policy.npz"]


def test_write_refuses_what_read_would_and_writes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    arrays = policies.arrays() | {"actor/mean/bias": _f32([[np.nan, 0]])}
    with pytest.raises(PolicyError, match=r"policy\.npz: actor/mean/bias holds a value"):
        policy_file.write(path, arrays, policies.meta())
    assert list(tmp_path.iterdir()) == []


def test_an_own_network_may_have_another_goal_and_step_limit() -> None:
    task = _said()["task"] | {"goal": "gather", "step_limit": 100}
    meta = _said() | {"network": "mine", "task": task}
    fields.check(policies.arrays(), meta)


def test_write_says_where_it_cannot_write(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(PolicyError, match=r"file/policy\.npz cannot be written: [^\n]+\.$"):
        saved(tmp_path / "file" / "policy.npz")


def _without(name: str) -> Arrays:
    return {key: array for key, array in policies.arrays().items() if key != name}


def _with(name: str, array: Any) -> Arrays:
    return policies.arrays() | {name: np.asarray(array)}


def _part(part: str, **changes: Any) -> dict[str, Any]:
    return {part: policies.meta()[part] | changes}


_GOOD = policies.arrays()
_RECALLS = policies.remembering(_GOOD, 5)
_MEMORY = {"memory": {"kind": "gru", "size": 5}}


@pytest.mark.parametrize(
    ("arrays", "meta", "sentence"),
    [
        (_without("actor/mean/bias"), {}, r"array actor/mean/bias is missing"),
        (_GOOD, _MEMORY, r"array actor/memory/input/kernel is missing"),
        (_RECALLS, {}, r"actor/mean/kernel has shape \[1, 8, 2\]: expected \[1, 3, 2\]"),
        (
            _RECALLS,
            _MEMORY | {"memory": {"kind": "lstm", "size": 5}},
            r'meta.memory.kind is "lstm": expec',
        ),
        (
            _RECALLS,
            _MEMORY | {"memory": {"kind": "gru", "size": 0}},
            r"meta.memory.size is 0: expected a whole number from 1 to",
        ),
        (
            _RECALLS,
            _MEMORY | {"memory": {"kind": "gru", "size": 4}},
            r"actor/mean/kernel has shape \[1, 8, 2\]: expected \[1, 7, 2\]",
        ),
        (
            _GOOD,
            _part("observation", neighbours={"count": 2, "range": 0.7}),
            r"meta.observation.neighbours is .*: expected nothing, because commit 8820a9f is the "
            r"last",
        ),
        (_GOOD, {"format": 2}, r"meta.format is 2, but this version reads only format 5: "),
        (_RECALLS, _MEMORY | {"network": "mine"}, r"meta.memory and meta.network are both"),
        (_without("actor/hidden_0/kernel"), {}, r"array actor/hidden_0/kernel is missing"),
        (_without("normalizer/std"), {}, r"array normalizer/std is missing"),
        (_with("critic/bias", _f32([1])), {}, r'array "critic/bias" is unknown: format 5'),
        (_with("actor/hidden_2/bias", _f32([[1]])), {}, r"array actor/hidden_2/kernel is missing"),
        (_with("actor/hidden_7/bias", _f32([[1]])), {}, r"array actor/hidden_2/kernel is missing"),
        (_with("actor/log_std", np.zeros((1, 2))), {}, r"actor/log_std is float64: expected float"),
        (_with("actor/log_std", np.zeros((1, 2), ">f4")), {}, r"actor/log_std is >f4: expected fl"),
        (
            _with("actor/mean/bias", _f32([[1, 2, 3]])),
            {},
            r"actor/mean/bias has shape \[1, 3\]: expected \[1, 2\]",
        ),
        (
            _with("normalizer/mean", np.zeros((1, 4), np.float32)),
            {},
            rf"normalizer/mean has shape \[1, 4\]: expected \[1, {SIZE}\]",
        ),
        (
            policies.arrays(learners=2),
            {},
            rf"actor/hidden_0/kernel has shape \[2, {SIZE}, 4\]: expected \[1, {SIZE}, 4\]",
        ),
        (
            _with("actor/hidden_1/bias", _f32([[0, np.inf, 0]])),
            {},
            r"actor/hidden_1/bias holds a value that is not finite",
        ),
        (
            _with("normalizer/std", _f32([[1] * (SIZE - 1) + [0]])),
            {},
            r"normalizer/std holds a value below 1\.18e-38",
        ),
        (
            _GOOD,
            {"format": 1},
            r"meta.format is 1, but this version reads only format 5: commit d8b3078 is the last "
            r"that "
            "reads formats 2 to 4",
        ),
        (_GOOD, {"activation": "gelu"}, r'meta.activation is "gelu": expected tanh or relu or sw'),
        (_GOOD, {"policy": "mine"}, r'meta.policy is "mine": expected shared or independent'),
        (_GOOD, {"learners": True}, r"meta.learners is true: expected a whole number"),
        (_GOOD, {"learners": 2}, r"meta.learners is 2: expected 1 for a shared policy"),
        (
            _GOOD,
            several(3) | {"learners": 0},
            r"meta.learners is 0: expected a whole number, 1 o",
        ),
        (_GOOD, {"update": "now"}, r'meta.update is "now": expected a whole number'),
        (_GOOD, {"seed": -1}, r"meta.seed is -1: expected a whole number, 0 or more"),
        (_GOOD, {"versions": None}, r"meta.versions is null: expected an object"),
        (
            _GOOD,
            _part("observation", names="abcde"),
            r'meta.observation.names is "abcde": expected a list of names',
        ),
        (
            _GOOD,
            _part("observation", names=["*/ int main;"] * SIZE),
            r"meta.observation.names is .*: expected a list of names in plain letters",
        ),
        (
            _GOOD,
            _part("observation", names=["same"] * SIZE),
            r"meta.observation.names is .*: expected different names",
        ),
        (
            _GOOD,
            _part("observation", units=["m"]),
            rf"meta.observation.units has 1 entries: expected {SIZE}",
        ),
        (
            _GOOD,
            _part("observation", encoding="feet"),
            r'meta.observation.encoding is "feet": expected metric or webots',
        ),
        (
            _GOOD,
            _part("observation", offset=[0.0]),
            rf"meta.observation.offset is \[0.0\]: expected {SIZE} finite numbers",
        ),
        (
            _GOOD,
            _part("observation", offset=[10**400] * SIZE),
            rf"meta.observation.offset is \[10+\.\.\.: expected {SIZE} finite numbers",
        ),
        # The division is in float32, where 1e-60 is 0.
        (_GOOD, _part("observation", scale=[1e-60] * SIZE), r"meta.observation.scale holds 0"),
        (
            _GOOD,
            _part("observation", limit=float("nan")),
            r"meta.observation.limit is NaN: expected a number above 0",
        ),
        (
            _GOOD,
            _part("action", names=["turn_rate", "speed"]),
            r'meta.action.names is \["turn_rate", "speed"\]: expected \["speed", "turn_rate"\]',
        ),
        (_GOOD, _part("action", high=[0.1]), r"meta.action.high is \[0.1\]: expected 2 finite num"),
        (
            _GOOD,
            _part("action", low=[-0.1, -3.14]),
            r"meta.action.low is \[-0.1, -3.14\].*a speed from 0 to high",
        ),
        (
            _GOOD,
            _part("observation", limit=3e38),
            r"meta.observation.limit is 3e\+38: expected a number",
        ),
        (
            _GOOD,
            _part("robot", wheel_radius=1e-60),
            r"meta.robot.wheel_radius is 1e-60: expected a number above 0",
        ),
        (_GOOD, _part("action", low=[0, -1e-60], high=[1, 1e-60]), r"meta.action.low is \[0, -1e-"),
        (
            _GOOD,
            _part("observation", units=["*/x/*"] * SIZE),
            r"meta.observation.units is .*: expected a list of units in plain letters",
        ),
        (
            _GOOD,
            _part("observation", units=["m/*s"] * SIZE),
            r"meta.observation.units is .*: expected a list of units in plain letters",
        ),
        (_GOOD, _part("robot", preset=""), r'meta.robot.preset is "": expected a name'),
        (_GOOD, _part("robot", body="boat"), r'meta.robot.body is "boat": expected planar or whe'),
        (_GOOD, _part("robot", track=0), r"meta.robot.track is 0: expected a number above 0"),
        (_GOOD, _part("sensors", response=1), r"meta.sensors.response is 1: expected ideal or web"),
        (_GOOD, _part("sensors", range=None), r"meta.sensors.range is null: expected a number ab"),
        (_GOOD, {"task": {}}, r"meta.task.control_step is missing: expected a number above 0"),
        (
            _GOOD,
            _part("task", arrival="stay"),
            r'meta.task.arrival is "stay": expected latch or hold',
        ),
    ],
)
def test_read_refuses_in_one_sentence(
    tmp_path: Path, arrays: Arrays, meta: dict[str, Any], sentence: str
) -> None:
    path = tmp_path / "policy.npz"
    forge(path, arrays, _said() | meta)
    with pytest.raises(PolicyError, match=rf"policy\.npz: {sentence}[^\n]*\.$"):
        policy_file.read(path)


@pytest.mark.parametrize("key", sorted(policies.meta()))
def test_read_names_what_meta_lacks(tmp_path: Path, key: str) -> None:
    said = _said()
    del said[key]
    path = tmp_path / "policy.npz"
    forge(path, _GOOD, said)
    with pytest.raises(PolicyError, match=rf"policy\.npz: meta\.{key} is missing"):
        policy_file.read(path)


def test_the_digest_covers_arrays_and_meta(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    sound = saved(path).digest
    faster = _said(**_part("action", high=[0.25, 3.14]))
    for arrays, said in ((policies.arrays(seed=1), _said()), (_GOOD, faster)):
        forge(path, arrays, said, digest=sound)
        with pytest.raises(
            PolicyError, match=r"its digest and its arrays do not match: it was chang"
        ):
            policy_file.read(path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{", r"meta cannot be read as JSON: "),
        ("[1]", r"meta is \[1\]: expected a JSON object"),
        ('{"format": ' + "9" * 5000 + "}", r"meta cannot be read as JSON: "),
        ("[" * 60_000, r"meta cannot be read as JSON: "),
    ],
)
def test_read_refuses_foreign_meta(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "policy.npz"
    forge(path, _GOOD, text)
    with pytest.raises(PolicyError, match=rf"policy\.npz: {sentence}"):
        policy_file.read(path)


def _npz(members: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **members)
    return buffer.getvalue()


def _zip(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return buffer.getvalue()


def _members(content: bytes) -> list[tuple[str, bytes]]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [(name, archive.read(name)) for name in archive.namelist()]


def _npy(descr: str, shape: str, data: bytes = b"", spaces: int = 0) -> bytes:
    """Returns a member with any header, sound or not."""
    said = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}"
    header = f"{said}{' ' * spaces}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


@pytest.mark.parametrize(
    "data",
    [
        _npy("<f4", "2000000000, 2"),
        _npy("<f4", "200000000, 2"),
        # NumPy has 64 axes at most. A shape with an axis of 0 needs no data, however large its
        # other axes are.
        _npy("<f4", ", ".join("1" * 65), b"\0" * 4),
        _npy("<c16", "0, 999999999, 999999999"),
        _npy("<f4", "01, 2", b"\0" * 8),
        _npy("<f4", "1, 2", b"\0" * 8, spaces=10_000),
        _npy("|O", "1, 2", b"\0" * 16),
        _npy("<f9", "1, 2", b"\0" * 18),
        _npy("<U0", "", b""),
        b"",
        b"\x93NUMPY\x01\x00\xff\xff",
    ],
)
def test_read_refuses_a_forged_member(tmp_path: Path, data: bytes) -> None:
    sentence = "'actor/mean/bias.npy' does not match its header"
    assert sentence in _refused(tmp_path, "actor/mean/bias", data)


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("meta", _npy("<U1", "", b"\xff\xff\xff\xff"), "code point not in range"),
        ("meta", _npy("<f4", "", b"\0" * 4), "meta is not a text of at most 1048576 characters"),
        ("digest", _npy("<U1", "2,", b"\0" * 8), "digest is not a text of at most 1048576 charac"),
    ],
)
def test_read_refuses_a_forged_text(tmp_path: Path, name: str, data: bytes, sentence: str) -> None:
    assert sentence in _refused(tmp_path, name, data)


def _refused(folder: Path, name: str, data: bytes) -> str:
    """Returns the sentence that refuses a policy with this member."""
    path = folder / "policy.npz"
    saved(path)
    members = dict(_members(path.read_bytes())) | {f"{name}.npy": data}
    path.write_bytes(_zip(list(members.items())))
    with pytest.raises(
        PolicyError, match=r"policy\.npz cannot be read as a policy: [^\n]*\.$"
    ) as caught:
        policy_file.read(path)
    return str(caught.value)


@pytest.mark.parametrize(
    "name", ["../evil", "/meta", "actor/hidden_0/kernel/x", "a\nb", "network/a/../b", "network/"]
)
def test_read_refuses_arrays_that_no_policy_has(tmp_path: Path, name: str) -> None:
    forge(tmp_path / "policy.npz", _with(name, _f32([1])), _said())
    with pytest.raises(
        PolicyError, match=r'policy\.npz: array "[^\n]+" is unknown: format 5 has no'
    ):
        policy_file.read(tmp_path / "policy.npz")


def test_read_refuses_members_that_no_policy_has(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    saved(path)
    members = _members(path.read_bytes())
    with pytest.warns(UserWarning, match="Duplicate"):
        doubled = _zip([*members, members[0]])
    # A compressed member could unpack to any size.
    compressed = _zip(members, zipfile.ZIP_DEFLATED)
    for content in (doubled, compressed, _zip([*members, ("meta", b"")])):
        path.write_bytes(content)
        with pytest.raises(
            PolicyError, match=r"duplicated or no \.npy file|unpacks to more than its"
        ):
            policy_file.read(path)


def test_read_refuses_members_that_overlap(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    saved(path)
    content = path.read_bytes()
    names = [name for name, _ in _members(content)]
    with zipfile.ZipFile(path) as archive:
        sizes = [member.file_size for member in archive.infolist()]
        start = archive.start_dir
    # Every entry of the archive's directory claims to have as many bytes as the whole file.
    directory = bytearray(content[start:])
    at = 0
    for name in names:
        at = directory.index(b"PK\x01\x02", at)
        directory[at + 20 : at + 28] = len(content).to_bytes(4, "little") * 2
        at += 46 + len(name)
    path.write_bytes(content[:start] + bytes(directory))
    assert len(names) * len(content) > sum(sizes)
    with pytest.raises(
        PolicyError, match=("it unpacks to more than its size, or to over 1073741824 bytes")
    ):
        policy_file.read(path)


def test_an_open_file_is_read_wherever_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    digest = saved(path).digest
    with path.open("rb") as file:
        file.seek(1000)
        assert policy.load(file).digest == digest


def test_read_refuses_what_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # reading it would wait for ever
    for path in (tmp_path / "none.npz", tmp_path, tmp_path / "pipe", "a\0b"):
        with pytest.raises(PolicyError, match=r" is (not a file|a folder): | cannot be read: "):
            policy_file.read(path)


class _Trap:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Path]]:
        return Path.touch, (self.mark,)


# Damage


def _truncated(content: bytes, draw: np.random.Generator, _: Path) -> bytes:
    return content[: draw.integers(len(content))]


def _flipped(content: bytes, draw: np.random.Generator, _: Path) -> bytes:
    changed = bytearray(content)
    for at in draw.integers(len(content), size=draw.choice([1, 1, 1, 8])):
        changed[at] ^= 1 << draw.integers(8)
    return bytes(changed)


def _overwritten(content: bytes, draw: np.random.Generator, _: Path) -> bytes:
    """Overwrites a block with noise, as a bad sector does."""
    size = int(draw.integers(1, 600))
    at = int(draw.integers(len(content)))
    return content[:at] + draw.bytes(size) + content[at + size :]


def _spliced(content: bytes, draw: np.random.Generator, _: Path) -> bytes:
    """Removes a range of bytes or doubles it."""
    start, end = sorted(int(at) for at in draw.integers(len(content) + 1, size=2))
    return (
        content[:start] + content[end:] if draw.random() < 0.5 else content[:end] + content[start:]
    )


def _pickled(content: bytes, draw: np.random.Generator, mark: Path) -> bytes:
    """Replaces a member, or the whole file, by a pickle that would run code when loaded."""
    if draw.random() < 0.2:
        return pickle.dumps(_Trap(mark))
    members = dict(_members(content))
    name = draw.choice(sorted(members))
    trap = np.empty((), object)
    trap[()] = _Trap(mark)
    members[name] = _members(_npz({"trap": trap}))[0][1]
    return _zip(list(members.items()))


def _foreign(content: bytes, draw: np.random.Generator, _: Path) -> bytes:
    """Makes one thing in a sound archive wrong and stores the digest of the result."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = dict(archive)
    meta = json.loads(str(arrays.pop("meta")))
    del arrays["digest"]
    name = str(draw.choice(sorted(arrays)))
    value = arrays[name]
    kind = draw.integers(6)
    if kind == 0:
        meta["format"] = int(draw.choice([0, 1, 3, 2**31]))
    elif kind == 1:
        value.reshape(-1)[draw.integers(value.size)] = draw.choice([np.nan, np.inf, -np.inf])
    elif kind == 2:
        arrays[name] = value.astype(draw.choice(["f8", "f2", "i4", ">f4", "c8"]))
    elif kind == 3:
        arrays[name] = np.repeat(value, 2, axis=int(draw.integers(value.ndim)))
    elif kind == 4:
        del arrays[name]
    else:
        del meta[str(draw.choice(sorted(meta)))]
    arrays["meta"] = np.array(json.dumps(meta))
    arrays["digest"] = np.array(policy.digest(arrays))
    return _npz(arrays)


def _repeated(content: bytes, draw: np.random.Generator, _: Path) -> bytes:
    members = _members(content)
    return _zip([*members, members[draw.integers(len(members))]])


_DAMAGES = (_truncated, _flipped, _overwritten, _spliced, _pickled, _foreign, _repeated)
_EACH = 200


def _damaged(content: bytes, mark: Path) -> Iterator[tuple[str, bytes]]:
    draw = np.random.default_rng(0)
    for damage in _DAMAGES:
        for _ in range(_EACH):
            yield damage.__name__, damage(content, draw, mark)


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
def test_of_1400_damaged_files_each_is_refused_or_reads_as_before(tmp_path: Path) -> None:
    path, mark = tmp_path / "policy.npz", tmp_path / "mark"
    policy_file.write(path, policies.arrays(), policies.meta())
    whole = policy_file.read(path)
    content = path.read_bytes()
    same = dict.fromkeys((damage.__name__ for damage in _DAMAGES), 0)
    for name, damaged in _damaged(content, mark):
        path.write_bytes(damaged)
        for read in (policy_file.read, policy.load):
            try:
                found = read(path)
            except PolicyError as error:
                sentence = str(error)
                assert "\n" not in sentence
                assert sentence.endswith(".")
                assert str(path) in sentence
                continue
            if read is policy_file.read:
                same[name] += 1
                # Damage to the archive's times or attributes does not change the content.
                assert (found.meta, found.digest) == (whole.meta, whole.digest)
                for array, expected in zip(_arrays(found), _arrays(whole), strict=True):
                    np.testing.assert_array_equal(array, expected)
    assert not mark.exists()  # nothing was unpickled
    never = {"_truncated", "_pickled", "_foreign", "_repeated"}
    assert all(same[name] == 0 for name in never)
    # Most bytes are covered by a checksum or belong to a name. A few bytes, such as the
    # file's times, are not protected.
    assert 0 < same["_flipped"] < 0.2 * _EACH


def _arrays(found: policy.Policy) -> list[np.ndarray]:
    return [
        found.log_std,
        found.mean,
        found.std,
        *(part for layer in found.layers for part in layer),
    ]


def test_unpickling_the_trap_would_leave_a_mark(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    content = _pickled(_npz(policies.arrays()), np.random.default_rng(1), mark)
    with np.load(io.BytesIO(content), allow_pickle=True) as archive:
        list(archive.values())
    assert mark.exists()


@pytest.mark.parametrize("name", ["evaluate", "export"])
def test_commands_refuse_damaged_files_with_exit_code_2(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = {
        "evaluate": (evaluate_command.main, EvaluateConfig),
        "export": (export.main, ExportConfig),
    }
    path, mark = tmp_path / "policy.npz", tmp_path / "mark"
    saved(path)
    content, draw = path.read_bytes(), np.random.default_rng(2)
    words = {"evaluate": ["stage=s1", "episodes=1"], "export": ["format=c"]}[name]
    monkeypatch.setattr("sys.argv", [name, f"policy={path}", *words])
    for damage in (_truncated, _overwritten, _pickled, _foreign):
        path.write_bytes(damage(content, draw, mark))
        assert command.run(name, *commands[name]) == USER_ERROR
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith(f"swarmjax.{name}: error: {path}")
        assert said.err.count("\n") == 1
    assert [found.name for found in tmp_path.iterdir()] == ["policy.npz"]


# The parts of `meta` that commands read beside what `policy_file` has always checked.
_READ = ("robot", "sensors", "task", "realism", "stages", "action", "observation")


def _places(found: Any) -> Iterator[tuple[Any, Any]]:
    """Yields each place of nested plain data: a list or mapping, and a key of it."""
    for key in list(found) if isinstance(found, dict) else range(len(found)):
        yield found, key
        if isinstance(found[key], dict | list):
            yield from _places(found[key])


_RARE = [pytest.param(each, marks=pytest.mark.slow) for each in ([1, 2], {}, 10**400)]


@pytest.mark.parametrize("value", ["x", None, -1, float("nan"), *_RARE], ids=repr)
def test_any_field_of_a_signed_file_may_hold_anything(tmp_path: Path, value: Any) -> None:
    path, arrays = tmp_path / "policy.npz", policies.arrays()
    trained = {"format": FORMAT, **policy_meta(load_train(["stage=s1"]), update=1, seed=0)}
    places = [_places(part) for name, part in trained.items() if name in _READ]
    for where, key in itertools.chain(*places):
        before, where[key] = where[key], value
        forge(path, arrays, trained)
        where[key] = before
        with contextlib.suppress(PolicyError, ConfigError):  # the only two errors that are allowed
            trained_settings.load(EvaluateConfig, [f"policy={path}"])
            export.convert(ExportConfig(policy=str(path), format="c"), path, tmp_path / "out")
