"""Shares a tiny configuration, compiled once and kept between runs, with tests that simulate."""

import os

os.environ["JAX_PLATFORMS"] = "cpu"  # Set before anything imports JAX.
# Tests spend most of their time compiling, which optimisation level 0 cuts to two thirds. The slow
# tests of `-m slow` use it as well.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"

import functools
import signal
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
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.world import World
from swarmjax.training import program as programs

ArenaStep = Callable[[EnvState, jax.Array], tuple[EnvState, TimeStep]]

# A shell that starts pytest with `&` has it ignore signals, and commands keep them ignored.
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

hypothesis.settings.register_profile("swarmjax", deadline=None, derandomize=True)
hypothesis.settings.load_profile("swarmjax")


# The files that take longest begin first, so that both test processes end at about the same time.
LONGEST = (
    "training/test_seeds.py",
    "run/test_warm_start.py",
    "run/test_reliability.py",
    "run/test_checkpoint.py",
    "training/test_critic.py",
    "training/test_memory.py",
    "sim/test_physics.py",
    "run/test_train.py",
    "training/test_rollout.py",
    "paper/test_golden.py",
    "test_api.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the files of `LONGEST` before the others, in their order."""
    tests = Path(__file__).parent
    rank = {tests / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


def pytest_configure(config: pytest.Config) -> None:
    """Keeps compiled programs in `.pytest_cache`, so that a second run compiles less.

    Each test process shares a cache with the commands that it starts, but not with other test
    processes, since a process may read a file that another one has half written. Without
    `.pytest_cache` nothing is kept, so a test never touches the user's cache.
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
    """Returns a minimal run that has two stages, absent robots, obstacles and minibatches."""
    return TrainConfig(
        stage=(
            StageConfig(name="pair", robots=2, side=0.5),
            StageConfig(name="trio", robots=3, side=0.8, obstacles=2),
        ),
        # The reward is equation 3 of the paper alone, whose sums are easily computed by hand.
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
    """Returns the compiled control step of 8 arenas.

    The step takes a state with the physics' data, and actions [8, 3, 2].
    """
    return jax.jit(jax.vmap(functools.partial(env.step, tiny_world)))
