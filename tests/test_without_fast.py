"""Tests that training works, more slowly, without `sim/fast/` and `ppo/fast/`."""

import json
import subprocess
import sys
from pathlib import Path

WORDS = (
    "stage=s4 arenas=4 algo.rollout_length=16 algo.hidden_sizes=[8] algo.num_minibatches=2 "
    "budget=128 task.step_limit=16 run.tensorboard=false run.compile_cache=null run.dir=run"
)
BLOCKED = """
import sys
sys.modules["swarmjax.sim.fast"] = sys.modules["swarmjax.ppo.fast"] = None
sys.argv = ["train", *sys.argv[1:]]
import runpy
runpy.run_module("swarmjax.train", run_name="__main__", alter_sys=True)
"""


def _train(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", BLOCKED, *WORDS.split(), *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_tiny_run_trains_by_mjx_and_autodiff_alone(tmp_path: Path) -> None:
    done = _train(tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["updates"] == 2
    assert (summary["solver"], summary["update_backend"]) == ("mjx", "autodiff")
    assert summary["stepped_by"] == "MJX's own step"


def test_a_faster_way_that_is_asked_for_and_not_there_is_one_sentence(tmp_path: Path) -> None:
    done = _train(tmp_path, "sim.solver=swarm")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith(
        "sim.solver is swarm, but swarmjax.sim.fast cannot be imported: give mjx or auto."
    )
