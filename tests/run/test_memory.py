"""Checks how much device memory a run needs, how many arenas fit, and what is refused."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from swarmjax import train
from swarmjax.config import ConfigError
from swarmjax.exit_codes import INTERRUPTED
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run import compiled, memory
from swarmjax.run import run as runs
from swarmjax.run.load_settings import load_run, load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import StoppedError
from swarmjax.task.observation import SIZE
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import seeds

GIB = 2**30
SETTINGS = TrainConfig(stage=(StageConfig(name="pair", robots=2, side=0.5),), budget=10**9)


def _linear(fixed: int, each: int) -> Callable[[TrainConfig], int]:
    return lambda settings: fixed + each * settings.arenas


@pytest.mark.slow
def test_two_small_programs_tell_what_a_larger_one_takes(tiny_config: TrainConfig) -> None:
    fixed, each = memory.line(tiny_config, [16, 64], compiled.measure)
    found = compiled.measure(replace(tiny_config, arenas=512, budget=512 * 8))
    # XLA lays out the buffers of each program differently. The measured error is 1.0 %.
    assert fixed + 512 * each == pytest.approx(found, rel=0.02)
    # An arena needs at least the memory of its observations in the batch: 8 control steps of 3
    # robots, in float32.
    assert each > 8 * 3 * SIZE * 4


def test_the_bytes_of_a_tree_are_those_of_its_arrays() -> None:
    tree = {"a": jnp.zeros((3, 5)), "b": jnp.zeros(7, jnp.int8)}
    assert seeds.size(tree) == 3 * 5 * 4 + 7
    assert seeds.size(jax.eval_shape(lambda: tree)) == 3 * 5 * 4 + 7
    assert seeds.size(jax.random.split(jax.random.key(0), 4)) == 4 * 8  # a key has two words


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="Linux alone has it")
def test_a_cpu_has_all_the_memory_of_its_computer() -> None:
    found = re.search(r"MemTotal: +(\d+) kB", Path("/proc/meminfo").read_text())
    assert found is not None
    assert memory.limit() == int(found[1]) * 1024


# The choice


@pytest.mark.parametrize(
    ("available", "minibatches", "arenas"),
    [
        # 0.8 of 100e6 bytes hold 1e6 bytes and 1000 bytes for each of 79,000 arenas, which are
        # rounded down to 8 * 2^13.
        (10**8, 8, 65536),
        (75 * 10**6, 8, 32768),  # 59,000 fit
        (10**8, 6, 49152),  # 6 * 2^13
        (10**6, 8, 8),  # not even the fixed part fits; a later check refuses it
    ],
)
def test_auto_fills_the_share_with_a_power_of_two(
    available: int, minibatches: int, arenas: int
) -> None:
    settings = replace(
        SETTINGS,
        arenas=minibatches,
        algo=AlgoConfig(num_minibatches=minibatches),
    )
    chosen, why = memory.fill(settings, _linear(10**6, 1000), available)
    assert chosen == replace(settings, arenas=arenas)
    assert f"{arenas:,}" in why
    assert "1,000 bytes each" in why


def test_auto_stops_where_the_rest_of_the_config_does() -> None:
    # A budget of 1e6 control steps is enough for one update of 31,250 arenas.
    settings = replace(SETTINGS, budget=10**6)
    chosen, why = memory.fill(settings, _linear(0, 1000), 100 * GIB)
    assert chosen.arenas == 16384
    assert "twice as many are refused: budget is 1000000, but one update takes" in why
    assert "\n" not in why


def test_auto_measures_two_small_programs_whatever_the_budget() -> None:
    measured: list[tuple[int, int]] = []

    def measure(settings: TrainConfig) -> int:
        measured.append((settings.arenas, settings.updates))
        return 1000 * settings.arenas

    memory.fill(SETTINGS, measure, GIB)
    assert measured == [(2048, 1), (4096, 1)]
    measured.clear()
    # A budget of 512 control steps is enough for one update of 16 arenas, and not for more.
    assert memory.fill(replace(SETTINGS, arenas=8, budget=512), measure, GIB)[0].arenas == 16
    assert measured == [(8, 1), (16, 1)]
    measured.clear()
    assert memory.fill(replace(SETTINGS, arenas=8, budget=256), measure, GIB)[0].arenas == 8
    assert measured == [(8, 1)]


@pytest.mark.parametrize(("minibatches", "arenas"), [(8, 128), (6, 96), (200, 200)])
def test_auto_on_a_cpu_is_the_default(minibatches: int, arenas: int) -> None:
    settings = replace(SETTINGS, arenas=minibatches, algo=AlgoConfig(num_minibatches=minibatches))
    chosen, why = memory.fill(settings, lambda _: pytest.fail("nothing to measure"), None)
    assert chosen == replace(settings, arenas=arenas)
    assert why == f"arenas=auto: {arenas}, the default where no GPU reports its memory."


@pytest.mark.parametrize(
    ("backend", "available", "arenas"),
    # 0.8 of 100e6 bytes hold 1e6 bytes and 1000 bytes for each of 79,000 arenas, which are rounded
    # down to 8 * 2^13.
    [("cpu", 10**8, 128), ("gpu", 10**8, 65536), ("gpu", None, 128)],
)
def test_training_begins_with_the_choice(
    backend: str,
    available: int | None,
    arenas: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(memory, "limit", lambda: available)
    monkeypatch.setattr(runs, "measure", _linear(10**6, 1000))

    def stop(_: runs.Run) -> None:
        raise StoppedError

    monkeypatch.setattr(runs.Run, "load", stop)
    assert train.main([*WORDS, "arenas=auto", "run.dry=true"]) == INTERRUPTED
    assert capsys.readouterr().out.splitlines()[1].startswith(f"arenas=auto: {arenas:,}, ")


def test_the_command_line_takes_auto() -> None:
    settings, auto = load_run(["arenas=auto", "algo.num_minibatches=4"])
    assert auto
    assert settings.arenas == 4
    settings, auto = load_run(["arenas=auto", "arenas=64"])
    assert not auto
    assert settings.arenas == 64
    with pytest.raises(ConfigError, match=r"^arenas is 'auto': give a whole number\.$"):
        load_train(["arenas=auto"])
    with pytest.raises(
        ConfigError,
        match=r"^algo\.num_minibatches is 'many': give a whole "
        r"number\.$",
    ):
        load_run(["arenas=auto", "algo.num_minibatches=many"])


# Refusals


def test_what_fits_is_not_refused() -> None:
    memory.check(SETTINGS, GIB, GIB)
    memory.check(SETTINGS, GIB, None)
    memory.check_state(SETTINGS, GIB, GIB)
    memory.check_state(SETTINGS, GIB, None)


def test_a_run_too_large_is_refused_with_what_fits() -> None:
    settings = replace(SETTINGS, arenas=1000)
    # 1000 * 0.95 * 3 / 4 = 712.5, rounded down to 712, a multiple of 8.
    with pytest.raises(ConfigError) as caught:
        memory.check(settings, 4 * GIB, 3 * GIB)
    assert str(caught.value) == (
        "arenas is 1000, but training needs 4 GiB of memory and there is 3 GiB: give at most "
        "about 712."
    )
    with pytest.raises(ConfigError) as caught:
        memory.check(replace(settings, seeds=10), 4 * GIB, 3 * GIB)
    assert str(caught.value).startswith("arenas is 1000 for each of 10 seeds, but training needs ")
    with pytest.raises(ConfigError) as caught:
        memory.check_state(settings, 4 * GIB, 3 * GIB)
    assert str(caught.value) == (
        "arenas is 1000, but its state alone needs 4 GiB of memory and there is 3 GiB: give less "
        "than 744."  # 750
    )


def test_where_fewer_arenas_cannot_be_something_else_is_named() -> None:
    with pytest.raises(ConfigError) as caught:
        memory.check(replace(SETTINGS, arenas=8), 4 * GIB, 3 * GIB)
    assert str(caught.value).endswith(": give fewer seeds, sim.max_robots or algo.rollout_length.")
    with pytest.raises(ConfigError) as caught, memory.refusal(replace(SETTINGS, arenas=8)):
        raise jax.errors.JaxRuntimeError("INTERNAL: CUDA_ERROR_OUT_OF_MEMORY: out of memory")
    assert str(caught.value) == (
        "arenas is 8, but the memory of the device is full: give fewer seeds, sim.max_robots or "
        "algo.rollout_length."
    )
    with pytest.raises(ConfigError) as caught:
        memory.check(replace(SETTINGS, resume="runs/one"), 4 * GIB, 3 * GIB)
    assert str(caught.value).endswith(": continue the run on a device with more memory.")


def test_a_device_that_is_full_is_one_sentence() -> None:
    with pytest.raises(ConfigError) as caught, memory.refusal(replace(SETTINGS, arenas=1000)):
        jnp.zeros(2**46, jnp.float32)  # more than a processor can address
    assert str(caught.value) == (
        "arenas is 1000, but the memory of the device is full: give about 496."  # 500
    )


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


def test_a_state_too_large_is_refused_before_anything_is_compiled_or_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "limit", lambda: 2**20)
    for each in ("_first_state", "compile"):
        monkeypatch.setattr(runs.Run, each, lambda *_: pytest.fail("nothing to do"))
    with pytest.raises(ConfigError, match=r"^arenas is 1048576, but its state alone needs "):
        train.main([*WORDS, "arenas=1048576", f"run.dir={tmp_path / 'run'}"])
    assert not (tmp_path / "run").exists()


def test_an_absurd_number_is_refused_by_the_config() -> None:
    with pytest.raises(ConfigError, match=r"^arenas is 100000000: give 1 to 1048576\.$"):
        train.main(["arenas=100000000"])


def test_a_program_too_large_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    large = compiled.Compiled(lambda *_: pytest.fail("never called"), 1.0, GIB, GIB)
    monkeypatch.setattr(runs, "compile_chunk", lambda *_: large)
    monkeypatch.setattr(runs.Run, "_first_state", lambda *_: None)
    monkeypatch.setattr(memory, "limit", lambda: 2 * GIB - 1)
    for words in ([], ["run.dry=true"]):
        with pytest.raises(
            ConfigError, match=r"^arenas is 64, but training needs 2 GiB of .*56\.$"
        ):
            train.main([*WORDS, "arenas=64", f"run.dir={run}", *words])
    assert not run.exists()
