"""Job scripts, under a stand-in for the scheduler that they call."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path for path in (ROOT / "launch").iterdir() if path.suffix in (".sh", ".sbatch"))
TINY = [
    "stage=s1",
    "arenas=4",
    "algo.num_minibatches=2",
    "algo.hidden_sizes=[8]",
    "run.tensorboard=false",
    "run.chunk=1",
]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_script_is_sound_bash(script: Path) -> None:
    subprocess.run(["bash", "-n", str(script)], check=True)


def test_a_job_is_asked_for_again_before_its_time_is_up(tmp_path: Path) -> None:
    told = tmp_path / "told"
    stand_in = tmp_path / "scontrol"
    stand_in.write_text(f'#!/bin/sh\necho "$@" > {told}\n')
    stand_in.chmod(0o755)
    run = tmp_path / "run"
    words = [*TINY, f"run.dir={run}", "budget=1e8"]
    job = subprocess.Popen(
        ["bash", str(ROOT / "launch" / "slurm.sbatch"), *words],
        cwd=ROOT,
        env=os.environ
        | {
            "PATH": f"{tmp_path}:{os.environ['PATH']}",
            "PYTHON": sys.executable,
            "SLURM_JOB_ID": "17",
            "SLURM_GPUS_ON_NODE": "1",
        },
    )
    while not (run / "metrics.jsonl").exists():
        assert job.poll() is None
        time.sleep(0.1)
    job.send_signal(signal.SIGUSR1)
    assert job.wait(timeout=120) == 0
    assert told.read_text() == "requeue 17\n"
