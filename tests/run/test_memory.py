"""Checks how much device memory a run needs, and what is refused."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from swarmjax import train
from swarmjax.config import ConfigError
from swarmjax.run import compiled, directory, memory
from swarmjax.run import run as runs
from swarmjax.run.settings import TrainConfig
from swarmjax.task.stage_config import StageConfig

GIB = 2**30
SETTINGS = TrainConfig(stage=(StageConfig(name="pair", robots=2, side=0.5),), budget=10**9)


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="Linux alone has it")
def test_a_cpu_has_all_the_memory_of_its_computer() -> None:
    found = re.search(r"MemTotal: +(\d+) kB", Path("/proc/meminfo").read_text())
    assert found is not None
    assert memory.limit() == int(found[1]) * 1024


# Refusals


@pytest.mark.parametrize("available", [GIB, None])
def test_what_fits_is_not_refused(available: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "limit", lambda: available)
    memory.check(SETTINGS, GIB)


@pytest.mark.parametrize(("arenas", "fits"), [(1000, 712), (8, 8)])
def test_a_run_too_large_is_refused_with_what_fits(
    arenas: int, fits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "limit", lambda: 3 * GIB)
    settings = replace(SETTINGS, arenas=arenas)
    # 1000 * 0.95 * 3 / 4 = 712.5, rounded down to 712, a multiple of 8.
    with pytest.raises(ConfigError) as caught:
        memory.check(settings, 4 * GIB)
    assert str(caught.value) == (
        f"arenas is {arenas} and seeds is 1, which needs 4 GiB of memory, but 3 GiB is there: give "
        f"at most about {fits} arenas, or fewer seeds."
    )


def test_a_device_that_is_full_is_one_sentence() -> None:
    with pytest.raises(ConfigError) as caught, memory.refusal(replace(SETTINGS, arenas=1000)):
        jnp.zeros(2**46, jnp.float32)  # more than a processor can address
    assert str(caught.value).startswith("arenas is 1000, but the memory of the device is full: ")


def test_other_errors_of_a_device_pass() -> None:
    with (
        pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"),
        memory.refusal(SETTINGS),
    ):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")


WORDS = [
    "stage=s1",
    "sim.impl=jax",
    "sim.max_robots=2",
    "sim.max_obstacles=0",
    "algo.rollout_length=2",
    "algo.epochs=1",
    "algo.hidden_sizes=[4]",
    "task.step_limit=8",
    "budget=1e9",
]


def test_an_absurd_number_is_refused_by_the_config() -> None:
    with pytest.raises(ConfigError, match=r"^arenas is 100000000: give 1 to 1048576\.$"):
        train.main(["arenas=100000000"])


def test_a_program_too_large_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    large = compiled.Compiled(lambda *_: pytest.fail("never called"), 1.0, 2 * GIB)
    monkeypatch.setattr(runs, "compile_chunk", lambda *_, **__: large)
    monkeypatch.setattr(runs.Run, "_first_state", lambda *_: None)
    monkeypatch.setattr(memory, "limit", lambda: 2 * GIB - 1)
    with pytest.raises(ConfigError, match=r"^arenas is 64 .* at most about 56 arenas"):
        train.main([*WORDS, "arenas=64", f"run.dir={run}"])
    assert directory.visible(run) == []
