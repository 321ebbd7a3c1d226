"""One tiny configuration, compiled once and kept between runs, for every test that simulates."""

import os

os.environ["JAX_PLATFORMS"] = "cpu"  # before anything imports JAX
# Most of the time is compiling, which takes two thirds as long so; proofs with `-m slow` as well.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"

import functools
from collections.abc import Callable
from pathlib import Path

import hypothesis
import jax
import pytest

from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import SimConfig
from swarmjax.task import env
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.env import EnvState, TimeStep, World
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs

ArenaStep = Callable[[EnvState, jax.Array], tuple[EnvState, TimeStep]]

hypothesis.settings.register_profile("swarmjax", deadline=None, derandomize=True)
hypothesis.settings.load_profile("swarmjax")


# Files that take longest begin first, so that both processes end at about the same time.
LONGEST = (
    "training/test_mesh.py",
    "run/test_reliability.py",
    "run/test_train.py",
    "ppo/fast/test_fused.py",
    "training/test_loop.py",
    "test_api.py",
    "test_examples.py",
    "run/test_printed_commands.py",
    "run/test_warm_start.py",
    "sim/test_physics.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the files of `LONGEST` before the others, in their order."""
    tests = Path(__file__).parent
    rank = {tests / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


def pytest_configure(config: pytest.Config) -> None:
    """Keeps compiled programs in `.pytest_cache`, so that a second run compiles less.

    Each process has its own, with the commands that it starts: one may read what another has half
    written. Without `.pytest_cache` nothing is kept: a test never touches the user's cache.
    """
    cache = getattr(config, "cache", None)  # absent with -p no:cacheprovider
    if cache is None:
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
        jax.config.update("jax_enable_compilation_cache", False)
        return
    process = os.environ.get("PYTEST_XDIST_WORKER", "alone")
    directory = str(cache.mkdir(f"jax-{process}"))
    os.environ["JAX_COMPILATION_CACHE_DIR"] = directory
    jax.config.update("jax_compilation_cache_dir", directory)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@pytest.fixture(scope="session")
def tiny_config() -> TrainConfig:
    """The smallest run that has everything: two stages, absent robots, obstacles, minibatches."""
    return TrainConfig(
        stage=(
            StageConfig(name="pair", robots=2, side=0.5),
            StageConfig(name="trio", robots=3, side=0.8, obstacles=2),
        ),
        # Equation 3 alone, whose sums are easily worked out.
        task=TaskConfig(
            step_limit=16, reward=RewardConfig(proximity=-0.001, contact=0.0, step_penalty=0.0)
        ),
        algo=AlgoConfig(hidden_sizes=(8,), rollout_length=8, num_minibatches=2, epochs=2),
        sim=SimConfig(impl="jax", max_robots=3, max_obstacles=2),
        arenas=8,
        budget=8 * 8 * 20,
    )


@pytest.fixture(scope="session")
def tiny_world(tiny_config: TrainConfig) -> World:
    return programs.load_world(tiny_config)


@pytest.fixture(scope="session")
def tiny_step(tiny_world: World) -> ArenaStep:
    """One control step of 8 arenas: state with the physics' data, action [8, 3, 2]."""
    return jax.jit(jax.vmap(functools.partial(env.step, tiny_world)))
