"""Tries the wheel with the oldest and the newest versions that pyproject.toml allows.

    uv run python .ci/versions.py                     # oldest, newest, newest with Playground
    uv run python .ci/versions.py newest              # one of them: oldest, newest, playground
    uv run python .ci/versions.py --python 3.13       # another Python

Each goes into an environment of its own, without the tree and without its constraints. There the
console script trains on a user's stage, goes on, and judges, shows and exports the policy; Python
steps both bodies, Pyright reads a user's file, and the tests of `TESTS` run. It takes minutes and
is no part of `.ci/run`.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
UV = os.environ.get("UV", "uv")  # `uv run` sets it
RESOLUTIONS = {"oldest": "lowest-direct", "newest": "highest", "playground": "highest"}
# Libraries that share an environment with swarmjax: more extras, and what calls them.
EXTRAS = {"playground": ["playground"]}
TOLD = ("jax", "flax", "optax", "orbax-checkpoint", "chex", "numpy", "mujoco-mjx", "warp-lang")
TOLD += ("matplotlib", "rich", "tensorboardx", "playground", "brax")
# Tests of what calls JAX, Flax, Optax and MuJoCo most; brax is not installed, and a test that
# switches JAX to 64 bits does so as only JAX 0.8 and later can.
TESTS = [
    *(f"tests/ppo/test_{name}.py" for name in ("gae", "losses", "networks", "normalizer")),
    *(f"tests/ppo/test_{name}.py" for name in ("optimizer", "monte_carlo")),
    *(f"tests/sim/test_{name}.py" for name in ("drive", "model", "motor", "noise", "planar")),
    *(f"tests/{name}.py" for name in ("config/test_section", "test_policy", "test_policy_file")),
]
TOOLS = ["hypothesis", "pytest", "pytest-xdist"]
STAGE = "name: mine\nrobots: 3\nside: 0.8\nobstacles: 2\n"
SMALL = ["algo.hidden_sizes=[16]", "task.step_limit=40"]
PYTHON_CALLS = """
import jax, swarmjax
for robot in ("planar", "wheeled"):
    env = swarmjax.make_env("mine.yaml", robot=robot, arenas=4)
    state = jax.jit(env.reset)(jax.random.key(0))
    state, outcome = jax.jit(env.step)(state, jax.numpy.zeros((4, 3, 2)))
    assert state.observation.shape == (4, 3, 10) and outcome.reward.shape == (4, 3)
assert swarmjax.load_policy("runs/a/policy.npz")
"""
PLAYGROUND_CALLS = """
import jax, swarmjax
from mujoco_playground import registry
from swarmjax.adapters.playground import SwarmMjxEnv
mine = SwarmMjxEnv(swarmjax.make_env("mine.yaml", arenas=1))
for env in (mine, registry.load("CartpoleBalance")):
    state = jax.jit(env.reset)(jax.random.key(0))
    assert jax.jit(env.step)(state, jax.numpy.zeros(env.action_size)).reward.shape == ()
"""
# A user's file: Pyright must find what is wrong in the last line, or calls the comment unnecessary.
TYPED = """
# pyright: strict, reportUnnecessaryTypeIgnoreComment=true
from pathlib import Path
import swarmjax
result: swarmjax.TrainResult = swarmjax.train_policy({"stage": "s3"})
run: Path = result.run
swarmjax.make_env("s6", arenas="many")  # pyright: ignore[reportArgumentType]
"""
# What is run in an empty folder, by what it shows.
COMMANDS = {
    "version": ["swarmjax", "--version"],
    "train on two devices": [
        *("swarmjax", "train", "stage=mine.yaml", "arenas=16", "devices=2", "budget=20480"),
        *("run.dir=runs/a", *SMALL),
    ],
    "resume": ["swarmjax", "train", "resume=runs/a", "budget=40960"],
    "evaluate": ["swarmjax", "evaluate", "policy=runs/a/policy.npz", "episodes=4", "out=judged"],
    "replay": ["swarmjax", "replay", "policy=runs/a/policy.npz", "level=0,1"],
    "report": ["swarmjax", "report", "run=runs/a"],
    "export": ["swarmjax", "export", "policy=runs/a/policy.npz", "format=c", "out=c"],
    "reproduce": ["swarmjax", "reproduce", "--help"],
    "Python": ["python", "-c", PYTHON_CALLS],
    "types": ["pyright", "--pythonpath", "python", "typed.py"],
}
MORE_COMMANDS = {"playground": {"Playground": ["python", "-c", PLAYGROUND_CALLS]}}


def main(arguments: Sequence[str]) -> int:
    """Tries one set of versions after the other; returns 1 if anything failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("which", nargs="*", help=f"{', '.join(RESOLUTIONS)}; default: all")
    parser.add_argument("--python", default=sys.executable, help="version or path of Python")
    given = parser.parse_args(arguments)
    which = given.which or list(RESOLUTIONS)
    if not set(which) <= RESOLUTIONS.keys():
        parser.error(f"give {' or '.join(RESOLUTIONS)}.")
    with tempfile.TemporaryDirectory() as folder:
        failed = [name for name in which if not _try(name, given.python, Path(folder))]
    sys.stdout.write(f"failed: {', '.join(failed)}\n" if failed else "all passed\n")
    return 1 if failed else 0


def _try(name: str, python: str, folder: Path) -> bool:
    """Tries a set of versions, tells what came of each step, and whether all passed."""
    environment = folder / name
    if not _step(f"{name}: install", *_install(environment, python)):
        return False
    _tell(environment)
    work = folder / f"{name}-work"
    work.mkdir()
    (work / "mine.yaml").write_text(STAGE)
    (work / "typed.py").write_text(TYPED)
    passed = [_step(f"{name}: {what}", [words], work) for what, words in _commands(environment)]
    for part in ("tests", "pyproject.toml"):
        copy = shutil.copytree if (PROJECT / part).is_dir() else shutil.copy
        copy(PROJECT / part, work / part)
    # Warnings are of versions to come: they fail the tests of the pinned versions alone.
    words = ["-m", "pytest", "-q", "-k", "not brax", "-o", "filterwarnings=", *TESTS]
    passed.append(_step(f"{name}: tests", [[str(environment / "bin/python"), *words]], work))
    return all(passed)


def _install(environment: Path, python: str) -> tuple[list[list[str]], Path]:
    """The commands that make an environment, and where to run them: away from the constraints."""
    dist = environment.with_name(f"{environment.name}-dist")
    dist.mkdir()
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    # uv takes the lowest of what it is asked for itself alone, not of what a wheel asks for.
    also = ("onnx", "warp", *EXTRAS.get(environment.name, []))
    asked = [*project["dependencies"], *(one for extra in also for one in extras[extra])]
    (dist / "asked.txt").write_text("\n".join(asked))
    into = [UV, "pip", "install", "--quiet", "--python", str(environment / "bin/python")]
    commands = [
        [UV, "build", "--quiet", "--python", python, "--out-dir", str(dist), str(PROJECT)],
        [UV, "venv", "--quiet", "--python", python, str(environment)],
        [*into, "--resolution", RESOLUTIONS[environment.name], "--upgrade", "-r", "asked.txt"],
        # What runs the tests comes as it is, and moves nothing that was resolved.
        [*into, *TOOLS, f"swarmjax-{project['version']}-py3-none-any.whl"],
    ]
    return commands, dist


def _commands(environment: Path) -> list[tuple[str, list[str]]]:
    """What is run, with the paths of the environment's programs, and of this one's Pyright."""
    paths = {name: str(environment / "bin" / name) for name in ("python", "swarmjax")}
    paths["pyright"] = str(Path(sys.executable).with_name("pyright"))
    commands = (COMMANDS | MORE_COMMANDS.get(environment.name, {})).items()
    return [(what, [paths.get(word, word) for word in words]) for what, words in commands]


def _step(name: str, commands: list[list[str]], folder: Path) -> bool:
    """Runs commands in a folder, tells how long they took, and of a failure the last lines."""
    began = time.monotonic()
    flags = "--xla_backend_optimization_level=0 --xla_force_host_platform_device_count=2"
    names = {key: text for key, text in os.environ.items() if key != "VIRTUAL_ENV"}
    names |= {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags, "MPLBACKEND": "agg"}
    for words in commands:
        done = subprocess.run(
            words, cwd=folder, env=names, capture_output=True, text=True, check=False
        )
        if done.returncode:
            break
    came = "failed" if done.returncode else "passed"
    sys.stdout.write(f"{name:<32} {came} in {time.monotonic() - began:.0f} s\n")
    if done.returncode:
        sys.stdout.write("\n".join((done.stdout + done.stderr).splitlines()[-20:]) + "\n")
    sys.stdout.flush()
    return not done.returncode


def _tell(environment: Path) -> None:
    """Prints the versions that were installed."""
    words = [UV, "pip", "freeze", "--python", str(environment / "bin/python")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    found = [line for line in done.stdout.splitlines() if line.lower().split("==")[0] in TOLD]
    sys.stdout.write(f"  {', '.join(found).replace('==', ' ')}\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
