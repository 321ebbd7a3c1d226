"""Imports go one way. A new module must be given its place here."""

import ast
from pathlib import Path

import pytest

import swarmjax

ROOT = Path(swarmjax.__file__).parent
# A module imports from rows above its own, and a package from itself.
LAYERS = (
    {"epuck", "policy", "settings", "statistics"},
    {"compose", "policy_file", "webots_controller"},
    {"config"},
    {"sim"},
    {"task"},
    {"ppo"},
    {"rollout", "promotion"},
    {"curriculum"},
    {"curriculum_modes"},
    {"episodes"},
    {"loop"},
    {"seeds"},
    {"provenance", "checkpoint", "recorder", "display", "memory", "compile_cache"},
    {"report_rows"},
    {"reproduce_rows"},
    {"reproduce_measures"},
    {"reproduce_claims", "reproduce_figures"},
    {"reproduce_page"},
    {"command", "report_figures", "report_page", "trainer"},
    {"export_folder", "export_layout"},
    {"export_onnx", "export_c", "export_webots"},
    {"export"},
    {"start"},
    {"measures", "paths", "evaluate_rays"},
    {"evaluate_judge"},
    {"evaluate_c", "cells"},
    {"evaluate_mjx"},
    {"evaluate_run", "replay_record"},
    {"evaluate_summary", "evaluate_table", "evaluate_figures", "replay_pack"},
    {"replay_page", "replay_video"},
    {"report", "train", "evaluate", "replay"},
    {"reproduce_arms", "reproduce_judge"},
    {"reproduce"},
    {"suite"},
)
# These stand alone: the learner knows nothing of robots, a policy file needs only NumPy.
ONLY = {
    "ppo": {"config"},
    "policy": set(),
    "policy_file": {"policy"},
    "webots_controller": {"policy"},
    "epuck": set(),
    "settings": set(),
}
FILES = sorted(ROOT.rglob("*.py"))
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}


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


def test_every_module_has_its_place() -> None:
    found = {_unit(path.relative_to(ROOT).parts) for path in FILES} - {"__init__"}
    assert found == set(RANK)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_come_from_layers_above(path: Path) -> None:
    unit, imported = _unit(path.relative_to(ROOT).parts), _imports(path.read_text())
    allowed = {name for name, rank in RANK.items() if rank < RANK.get(unit, 0)}
    assert imported <= ONLY.get(unit, allowed) | {unit}


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
