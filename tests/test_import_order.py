"""Tests that imports between the rooms, the package's folders, go only one way."""

import ast
from pathlib import Path

import pytest

import swarmjax

ROOT = Path(swarmjax.__file__).parent
# `SHARED` holds what many rooms import. `ROOMS` lists all imports allowed to each room.
SHARED = {"config", "epuck", "extension", "policy", "policy_file", "outputs"}
SHARED |= {"provenance", "command", "exit_codes", "words", "life"}
ROOMS = {
    "config": set(),
    "sim": {"config", "epuck"},
    "task": {"config", "epuck", "extension", "sim"},
    "ppo": {"config", "extension", "shards"},
    "curriculum": {"config", "extension", "shards", "task", "words"},
    "training": SHARED | {"sim", "task", "ppo", "curriculum", "shards"},
    "run": SHARED | {"sim", "task", "ppo", "curriculum", "training"},
    "evaluate": SHARED | {"sim", "task", "pages"},
    "export": SHARED | {"sim", "run", "evaluate"},
    "pages": {"config", "outputs"},
    "policy_file": {"config", "policy", "policy_network", "extension", "outputs"},
    "replay": SHARED | {"sim", "task", "evaluate", "export", "pages"},
    "report": SHARED | {"task", "run", "evaluate", "pages"},
    "adapters": {"environment"},
    "reproduce": SHARED | {"task", "run", "evaluate", "pages", "report", "replay"},
    "shell": SHARED,
    "watch": SHARED | {"run", "pages", "report"},
}
# `ALSO` lists files that may import more than their room. The judge on the device uses the training
# code, and the cache of compiled programs belongs to `run`.
ALSO = {
    "evaluate/engine_mjx.py": {"policy_network", "training"},
    "evaluate/trials.py": {"run"},
}
# Shared modules import no room except `config`. policy.py, which users copy, imports nothing.
ALONE: dict[str, set[str]] = {
    "extension": {"config"},
    "policy": set(),
    "epuck": set(),
    "outputs": {"config"},
    "provenance": {"words"},
    "words": set(),
    "life": {"words"},
    "shards": set(),
    "policy_network": {"extension"},
    "command": {"config", "policy", "exit_codes"},
    "exit_codes": set(),
}
FILES = sorted(ROOT.rglob("*.py"))


def _imports(source: str) -> set[str]:
    """Returns what a file imports from swarmjax at any place in it, such as `sim.fast.discs`."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "no relative imports"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.partition(".")[2] for name in names if name.startswith("swarmjax.")}


def _place(path: Path) -> tuple[str, set[str], set[str]]:
    """Returns a file's room or module name, its imports, and the rooms that they belong to."""
    found = _imports(path.read_text())
    first = path.relative_to(ROOT).parts[0].removesuffix(".py")
    return first, found, {name.partition(".")[0] for name in found} - {first}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_room_imports_only_what_it_may(path: Path) -> None:
    first, _, rooms = _place(path)
    allowed = ALONE.get(first, rooms) if path.parent == ROOT else ROOMS[first]
    assert rooms <= allowed | ALSO.get(str(path.relative_to(ROOT)), set())


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_only_the_dispatcher_of_a_room_knows_its_fast_ways(path: Path) -> None:
    place = path.relative_to(ROOT)
    if "fast" not in place.parts and place.name != "dispatch.py":
        assert not [name for name in _imports(path.read_text()) if ".fast" in name]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nobody_imports_a_command(path: Path) -> None:
    _, found, rooms = _place(path)
    assert "train" not in rooms
    assert not [name for name in found if "__main__" in name]


def test_the_root_has_few_modules() -> None:
    assert len(list(ROOT.glob("*.py"))) <= 16


def test_imports_are_found_in_every_form() -> None:
    source = """
import swarmjax.training.loop
from swarmjax import config, ppo as p
from swarmjax.sim.gaps import KINDS
import jax
def f():
    from swarmjax import train
"""
    assert _imports(source) == {"training.loop", "config", "ppo", "sim.gaps.KINDS", "train"}


def test_no_class_name_is_used_twice() -> None:
    found = [
        node.name
        for folder in (ROOT, ROOT.parent / "benchmarks")
        for path in folder.rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    assert sorted(name for name in set(found) if found.count(name) > 1) == []
