"""Tests extensions: how their pieces are found, named, distinguished by digest, and refused."""

import re
from pathlib import Path

import extensions
import pytest
from sentences import refusal

from swarmjax import extension
from swarmjax.extension import Extensions
from swarmjax.run.load_settings import load_train
from swarmjax.task import observation, reward, stage_config
from swarmjax.training import program as programs

TERM = """
SCALE = 2.0
@reward_term(weight=0.5)
def speed(step):
    return SCALE * jnp.abs(step.action[:, 0])
"""


def _load(path: Path, body: str) -> Extensions:
    return extension.load(extensions.write(path, body))


def _digest(path: Path, body: str) -> str:
    return _load(path, body).rewards[0].digest


def test_every_kind_is_found_in_the_example() -> None:
    found = extension.load(str(extensions.OWN))
    names = [[piece.name for piece in pieces] for pieces in found]
    assert names == [["turning"], ["nearest_robot"], ["ring"], ["residual"], [], []]


def test_no_source_is_no_pieces() -> None:
    assert extension.load(None) == Extensions()


def test_a_digest_is_that_of_the_code_and_not_of_comments(tmp_path: Path) -> None:
    commented = TERM.replace("    return", "    '''What.'''\n    # why\n    return")
    assert _digest(tmp_path / "a.py", TERM) == _digest(tmp_path / "b.py", commented)


def test_a_digest_leaves_the_default_weight_out(tmp_path: Path) -> None:
    heavier = TERM.replace("weight=0.5", "weight=0.7")
    assert _digest(tmp_path / "a.py", TERM) == _digest(tmp_path / "b.py", heavier)


@pytest.mark.parametrize(
    ("old", "new"),
    [("SCALE = 2.0", "SCALE = 3.0"), ("jnp.abs", "jnp.square"), ("[:, 0]", "[:, 1]")],
)
def test_a_digest_changes_with_what_a_piece_computes(tmp_path: Path, old: str, new: str) -> None:
    changed = TERM.replace(old, new)
    assert _digest(tmp_path / "a.py", TERM) != _digest(tmp_path / "b.py", changed)


def test_a_digest_changes_with_a_function_that_a_piece_calls(tmp_path: Path) -> None:
    calling = TERM.replace("SCALE = 2.0", "def SCALED(x):\n    return 2.0 * x").replace(
        "SCALE * jnp.abs(step.action[:, 0])", "SCALED(step.action[:, 0])"
    )
    other = calling.replace("2.0 * x", "3.0 * x")
    assert _digest(tmp_path / "a.py", calling) != _digest(tmp_path / "b.py", other)


def test_an_edited_file_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    before = _digest(path, TERM)
    assert _digest(path, TERM.replace("2.0", "5.0")) != before


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("x = 1", r"a\.py defines no piece: put a decorator of swarmjax\.extension before a "
        "function"),
        ("import nowhere_to_be_found", r"a\.py cannot be imported: ModuleNotFoundError: No module"),
        ("def broken(:", r"a\.py cannot be imported: SyntaxError: "),
        ("1 / 0", r"a\.py cannot be imported: ZeroDivisionError: division by zero"),
        (TERM + TERM.replace("def speed", "def again").replace("0.5)", "0.5, name='speed')"),
         r"a\.py: reward speed is defined twice: rename one"),
        (TERM.replace("def speed", "def progress"),
         r"a\.py: reward progress has the name of a built-in reward: give it another name"),
        (TERM.replace("def speed", "def Speed"),
         r"a\.py: reward Speed does not have a valid name: give 1 to 40 lower-case letters"),
        ("@observation(size=0)\ndef a(view): return 0", r"observation a has size 0: "),
        ("@observation(scale=0)\ndef a(view): return 0", r"observation a has scale 0, but "),
        ("@reward_term\ndef a(step): return 0",
         r"a\.py defines no piece: put a decorator of swarmjax\.extension before a function"),
    ],
)  # fmt: skip
def test_an_unsound_file_is_one_sentence(tmp_path: Path, body: str, sentence: str) -> None:
    assert re.search(sentence, refusal(_load, tmp_path / "a.py", body))


def test_a_missing_file_is_one_sentence() -> None:
    assert refusal(extension.load, "no/such.py") == (
        "extensions is 'no/such.py', but no/such.py cannot be read: No such file or directory."
    )


def test_pieces_are_handed_over_by_a_word() -> None:
    found = extension.load(str(extensions.OWN))
    word = extension.hand_over([found.rewards[0], found.networks[0]])
    assert extension.load(word) == Extensions(rewards=found.rewards, networks=found.networks)


def test_a_word_of_another_program_is_refused() -> None:
    assert refusal(extension.load, "python:0123") == (
        "extensions is python:0123, which stands for pieces that only a Python program defined: "
        "put these pieces into a file, and give extensions=FILE."
    )


def test_what_is_no_piece_is_refused() -> None:
    sentence = refusal(extension.hand_over, [print])
    assert sentence.endswith("or functions with a decorator of swarmjax.extension.")


def test_names_of_the_package_are_taken() -> None:
    assert set(extension.TAKEN["reward"]) == set(reward.TERMS)
    assert extension.TAKEN["level"] == stage_config.BUILT_IN
    inputs = {re.sub(r"_\d+$", "", name) for name in observation.NAMES}
    assert set(extension.TAKEN["observation"]) == inputs


def test_a_piece_that_is_missing_or_has_changed_is_named() -> None:
    found = extension.load(str(extensions.OWN))
    needs = {"observation": {"nearest_robot": "0" * 64}}
    assert refusal(extension.check_needs, needs, Extensions(), "p.npz") == (
        "p.npz was trained with the observation nearest_robot of digest 000000000000, but "
        "extensions has no such piece: give extensions=FILE, the file of that training."
    )
    changed = refusal(extension.check_needs, needs, found, "p.npz")
    assert changed.startswith("p.npz was trained with the observation nearest_robot of digest 0000")


def test_only_the_kinds_that_matter_are_asked_for() -> None:
    needs = {"reward": {"turning": "0" * 64}}
    assert extension.check_needs(needs, Extensions(), "p", ["observation"]) is None
    assert refusal(extension.check_needs, needs, Extensions(), "p", ["reward"]).startswith("p was ")


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("import sys\nsys.exit()", "SystemExit: no reason given."),
        ("raise SystemExit('a')", "SystemExit: a."),
        ("class Own(BaseException): pass\nraise Own('b')", "Own: b."),
        ("raise GeneratorExit", "GeneratorExit: no reason given."),
    ],
)
def test_whatever_a_file_raises_is_one_sentence(tmp_path: Path, body: str, said: str) -> None:
    mine = extensions.write(tmp_path / "mine.py", body)
    assert refusal(extension.load, mine) == f"{mine} cannot be imported: {said}"


@pytest.mark.parametrize("code", ["import sys; sys.exit()", "raise BaseException"])
def test_whatever_a_piece_raises_is_one_sentence(tmp_path: Path, code: str) -> None:
    body = f"@reward_term(weight=1.0)\ndef mine(step):\n    {code}\n"
    words = ["stage=s1", f"extensions={extensions.write(tmp_path / 'mine.py', body)}"]
    config = load_train(words)
    assert f"{tmp_path / 'mine.py'}: reward mine fails: " in refusal(programs.load_world, config)


@pytest.mark.parametrize(
    ("decorator", "said"),
    [
        (
            "reward_term(weight='a')",
            "reward mine has weight 'a': give a number that float32 holds.",
        ),
        ("reward_term(weight=None)", "reward mine has weight null: give a number that float32"),
        ("reward_term(weight=True)", "reward mine has weight true: give a number that float32"),
        ("reward_term(weight=jnp.nan)", "reward mine has weight nan: give a number that float32"),
        ("reward_term(weight=10**400)", "reward mine has weight 100000000000000000000"),
        ("reward_term(weight=1.0, name=3)", "reward 3 does not have a valid name: give 1 to 40"),
        ("observation(scale='a')", "observation mine has scale 'a': give a number that float32"),
        ("observation(offset=jnp.inf)", "observation mine has offset inf: give a number that floa"),
        ("observation(size='a')", "observation mine has size 'a': give a whole number, 1 or mo"),
    ],
)
def test_a_number_of_a_wrong_kind_names_the_file(tmp_path: Path, decorator: str, said: str) -> None:
    mine = extensions.write(
        tmp_path / "mine.py", f"@{decorator}\ndef mine(x):\n    return x.distance\n"
    )
    assert refusal(extension.load, mine).startswith(f"{mine}: {said}")
