"""Tests the job scripts with stand-ins for the scheduler's commands."""

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


def _stand_in(folder: Path, name: str, line: str) -> Path:
    """Writes a stand-in command that records its arguments and then runs `line`.

    Returns the file with the arguments.
    """
    path = folder / name
    path.write_text(f'#!/bin/sh\necho "$@" > {folder / f"{name}.told"}\n{line}\n')
    path.chmod(0o755)
    return folder / f"{name}.told"


def _submit(script: str, folder: Path, *words: str, **variables: str) -> subprocess.Popen[bytes]:
    """Starts a job script as Slurm does, with the commands of a folder first on the path."""
    found = {"PATH": f"{folder}:{os.environ['PATH']}", "SLURM_JOB_ID": "17", **variables}
    command = ["bash", str(ROOT / "launch" / script), *words]
    return subprocess.Popen(command, cwd=ROOT, env=os.environ | found)


def test_an_array_gives_each_job_seeds_of_its_own(tmp_path: Path) -> None:
    told = _stand_in(tmp_path, "train", "exit 0")
    job = _submit(
        "slurm_seeds.sbatch",
        tmp_path,
        *("4", "runs/mine", "arenas=64"),
        PYTHON=str(tmp_path / "train"),
        SLURM_ARRAY_TASK_ID="3",
    )
    assert job.wait(timeout=60) == 0
    assert told.read_text() == (
        "-m swarmjax.train resume=auto seeds=4 seed=12 run.dir=runs/mine/3 arenas=64\n"
    )


@pytest.mark.parametrize(
    ("code", "requeued", "ends"), [(75, True, 0), (134, True, 0), (0, False, 0), (2, False, 2)]
)
def test_a_job_on_several_nodes_is_asked_for_again_by_its_exit_code(
    code: int, requeued: bool, ends: int, tmp_path: Path
) -> None:
    _stand_in(tmp_path, "srun", f"exit {code}")
    told = _stand_in(tmp_path, "scontrol", "exit 0")
    job = _submit("slurm_multinode.sbatch", tmp_path, "run.dir=runs/mine", SLURM_NTASKS="2")
    assert job.wait(timeout=60) == ends
    assert (tmp_path / "srun.told").read_text().endswith("devices=2 run.dir=runs/mine\n")
    assert told.exists() == requeued


def test_a_job_of_an_array_is_asked_for_again_alone(tmp_path: Path) -> None:
    _stand_in(tmp_path, "train", "exit 75")
    told = _stand_in(tmp_path, "scontrol", "exit 0")
    job = _submit(
        "slurm_seeds.sbatch",
        tmp_path,
        *("4", "runs/mine"),
        PYTHON=str(tmp_path / "train"),
        SLURM_ARRAY_JOB_ID="12",
        SLURM_ARRAY_TASK_ID="3",
    )
    assert job.wait(timeout=60) == 0
    assert told.read_text() == "requeue 12_3\n"


@pytest.mark.slow
def test_a_job_is_asked_for_again_before_its_time_is_up(tmp_path: Path) -> None:
    told = _stand_in(tmp_path, "scontrol", "exit 0")
    run = tmp_path / "run"
    job = _submit(
        "slurm.sbatch",
        tmp_path,
        *(*TINY, f"run.dir={run}", "budget=1e8"),
        PYTHON=sys.executable,
        SLURM_GPUS_ON_NODE="1",
    )
    while not (run / "metrics.jsonl").exists():
        assert job.poll() is None
        time.sleep(0.1)
    job.send_signal(signal.SIGUSR1)
    assert job.wait(timeout=120) == 0
    assert told.read_text() == "requeue 17\n"


def test_each_gpu_of_a_machine_gets_a_process(tmp_path: Path) -> None:
    path = tmp_path / "train"
    told = "$CUDA_VISIBLE_DEVICES $JAX_PROCESS_ID $JAX_NUM_PROCESSES $JAX_COORDINATOR_ADDRESS $@"
    path.write_text(f'#!/bin/sh\necho "{told}" >> {tmp_path / "told"}\nexit 75\n')
    path.chmod(0o755)
    job = _submit("local.sh", tmp_path, "runs/all", "arenas=64", PYTHON=str(path), GPUS="2")
    assert job.wait(timeout=60) == 75
    command = "-m swarmjax.train devices=2 run.dir=runs/all resume=auto run.distributed=true"
    assert sorted((tmp_path / "told").read_text().splitlines()) == [
        f"{i} {i} 2 127.0.0.1:12355 {command} arenas=64" for i in range(2)
    ]
