"""Checks that traces are kept, and used again only if nothing that they depend on changed."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from swarmjax import provenance
from swarmjax.run import traces
from swarmjax.run.settings import TrainConfig
from swarmjax.training import mesh
from swarmjax.training import program as programs


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Returns an empty folder, in which programs are kept."""
    before = jax.config.jax_compilation_cache_dir, jax.config.jax_enable_compilation_cache
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    jax.config.update("jax_enable_compilation_cache", True)
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before[0])
    jax.config.update("jax_enable_compilation_cache", before[1])


def _kept(program: Any, factor: float, size: int = 3) -> list[float]:
    """Keeps a program that multiplies by a factor, and calls what came back."""
    given = (np.ones(size, np.float32),)
    return traces.keep(program, "times", jax.jit(lambda x: factor * x), given)(*given).tolist()


def test_a_kept_trace_is_used_by_the_next_run(folder: Path, tiny_config: TrainConfig) -> None:
    assert _kept(programs.load(tiny_config)[0], 2.0) == [2.0] * 3
    assert _kept(programs.load(tiny_config)[0], 5.0) == [2.0] * 3  # this function is not traced


@pytest.mark.parametrize(
    "change",
    [
        lambda config: replace(config, arenas=16),
        lambda config: replace(config, budget=2 * config.budget),
        lambda config: replace(config, sim=replace(config.sim, max_robots=4)),
        lambda config: replace(config, algo=replace(config.algo, hidden_sizes=(4,))),
    ],
    ids=["arenas", "budget", "robots", "network"],
)
@pytest.mark.usefixtures("folder")
def test_other_settings_are_traced(change: Any, tiny_config: TrainConfig) -> None:
    _kept(programs.load(tiny_config)[0], 2.0)
    assert _kept(programs.load(change(tiny_config))[0], 5.0) == [5.0] * 3


@pytest.mark.usefixtures("folder")
def test_other_shapes_are_traced(tiny_config: TrainConfig) -> None:
    _kept(programs.load(tiny_config)[0], 2.0)
    assert _kept(programs.load(tiny_config)[0], 5.0, size=4) == [5.0] * 4


@pytest.mark.usefixtures("folder")
def test_another_version_is_traced(
    tiny_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    _kept(programs.load(tiny_config)[0], 2.0)
    monkeypatch.setattr(provenance, "versions", lambda: {"jax": "0.0.1"})
    assert _kept(programs.load(tiny_config)[0], 5.0) == [5.0] * 3


@pytest.mark.usefixtures("folder")
def test_changed_code_is_traced(
    tiny_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "package"
    shutil.copytree(Path(provenance.__file__).parent, package)
    monkeypatch.setattr(provenance, "__file__", str(package / "provenance.py"))
    _kept(programs.load(tiny_config)[0], 2.0)
    with (package / "task" / "env.py").open("a") as file:
        file.write("\n")
    assert _kept(programs.load(tiny_config)[0], 5.0) == [5.0] * 3


def test_a_damaged_trace_is_made_again(folder: Path, tiny_config: TrainConfig) -> None:
    _kept(programs.load(tiny_config)[0], 2.0)
    (file,) = folder.glob("*.trace")
    file.write_bytes(file.read_bytes()[:-10])
    assert _kept(programs.load(tiny_config)[0], 5.0) == [5.0] * 3
    assert _kept(programs.load(tiny_config)[0], 7.0) == [5.0] * 3


@pytest.mark.parametrize("change", [{"devices": 2}, {"extensions": "mine.py"}])
def test_nothing_is_kept_where_a_trace_depends_on_more(
    change: dict[str, Any], folder: Path, tiny_config: TrainConfig
) -> None:
    program = programs.load(tiny_config)[0]
    _kept(replace(program, config=replace(tiny_config, **change)), 2.0)
    assert not list(folder.glob("*.trace"))


def test_no_trace_depends_on_the_seed(tiny_config: TrainConfig) -> None:
    texts = set()
    for seed in (0, 1):
        program, schedule = programs.load(replace(tiny_config, seed=seed))
        init, given = jax.jit(mesh.init(program)), (schedule, mesh.lanes(program.config))
        chunk = mesh.jit_chunk(program).trace(schedule, init.eval_shape(*given), np.int32(1))
        texts.add(f"{init.trace(*given).jaxpr} {chunk.jaxpr}")
    assert len(texts) == 1


# Programs that call Warp, with a factor. A second process has the factor of the kept traces.
_WITH_WARP = """
import sys
import jax, numpy as np
from swarmjax import epuck
from swarmjax.run import traces
from swarmjax.run.load_settings import load_train
from swarmjax.sim import senses
from swarmjax.training import program as programs

program = programs.load(load_train(["stage=s1", "sim.impl=warp", "arenas=8", "budget=1e4"]))[0]
pose = np.array([[0.0, 0.0, 0.0], [0.08, 0.0, 1.0]], np.float32)
factor = float(sys.argv[1])

def look(reach, pose):
    scene = senses.Scene(pose, np.float32(1.0), np.zeros((0, 5), np.float32))
    each = [senses.look(scene, epuck.SENSOR_POSES, 0.037, reach + i, "warp").ray for i in range(2)]
    return factor * each[0], each[1]

for reach in (0.04, 0.06, 0.08):
    given = (np.float32(reach), pose)
    jitted = jax.jit(lambda _, pose, reach=reach: look(reach, pose))
    found = traces.keep(program, f"look-{reach}", jitted, given)(*given)
    print([ray.tolist() for ray in found])
"""


def test_a_kept_trace_calls_warp_in_the_next_process(folder: Path) -> None:
    def run(factor: str) -> str:
        words = [sys.executable, "-c", _WITH_WARP, factor]
        made = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder)}
        return subprocess.run(words, env=made, check=True, capture_output=True, text=True).stdout

    first = run("2.0")
    assert "0.0799999" in first  # m; twice the limit of 0.04 m, because that ray meets nothing
    kept = sorted(folder.glob("look-*.trace"))
    assert len(kept) == 3
    assert run("3.0") == first
    assert sorted(folder.glob("look-*.trace")) == kept
