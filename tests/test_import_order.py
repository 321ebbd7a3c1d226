"""Imports go one way, room by room."""

import ast
from pathlib import Path

import pytest

import swarmjax

ROOT = Path(swarmjax.__file__).parent
# What a room, or a module beside them, may import besides itself. Of a room's `fast/` only its
# dispatcher knows, and nobody imports a command.
SHARED = {"epuck", "policy", "policy_file", "provenance", "settings", "statistics", "compose"}
MAY_IMPORT = {
    "sim": {"config", *SHARED},
    "task": {"sim", "config", *SHARED},
    "ppo": {"config"},
    "curriculum": {"task", "config", "training"},
    "training": {"curriculum", "task", "sim", "ppo", "config"},
    "run": {"training", "curriculum", "task", "sim", "ppo", "config", "export", *SHARED},
    "policy": set(),
    "policy_file": {"policy"},
    "epuck": set(),
    "settings": set(),
}
FILES = sorted(ROOT.rglob("*.py"))


def _unit(parts: tuple[str, ...]) -> str:
    """The module or package directly below swarmjax."""
    return parts[0].removesuffix(".py")


def _imports(source: str) -> set[str]:
    """Units of swarmjax that a file imports, wherever it does so."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "no relative imports"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    paths = [tuple(name.split(".")) for name in names]
    return {path[1] for path in paths if path[0] == "swarmjax" and len(path) > 1}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_room_imports_only_what_it_may(path: Path) -> None:
    unit, imported = _unit(path.relative_to(ROOT).parts), _imports(path.read_text())
    assert imported <= MAY_IMPORT.get(unit, imported) | {unit}


def test_imports_are_found_in_every_form() -> None:
    source = """
import swarmjax.loop
from swarmjax import config, ppo as p
from swarmjax.sim.gaps import KINDS
import jax
def f():
    from swarmjax import train
"""
    assert _imports(source) == {"loop", "config", "ppo", "sim", "train"}
