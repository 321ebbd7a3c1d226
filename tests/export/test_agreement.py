"""Flax, NumPy, ONNX and compiled C compute the same actions."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import learners as ppo_parts
import numpy as np
import policies
import pytest
from policies import Arrays, saved, several

from swarmjax import outputs, policy
from swarmjax.export import c as export_c
from swarmjax.export import onnx as export_onnx
from swarmjax.policy import Policy
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Normalizer

OBSERVATIONS = 10_000
# The required agreement. Sums of 64 float32 terms differ only in their order. This changes actions
# of up to 2.5 units (tanh) by 1.1e-6, and actions of up to 16 units (relu, swish) by 8.2e-6. The
# full range of commands is 2 units.
TOLERANCE = 1e-5
SIZES = 10, 2  # numbers of an observation and of an action
Activation = Literal["tanh", "relu", "swish"]


def _by_flax(arrays: Arrays, activation: Activation, seen: np.ndarray) -> np.ndarray:
    """Returns actions [B, R, U] of the Flax networks; learner i drives robot i."""
    config = AlgoConfig(activation=activation)

    def act(mine: dict[str, jax.Array], observation: jax.Array) -> jax.Array:
        def layer(name: str) -> dict[str, jax.Array]:
            return {part: mine[f"actor/{name}/{part}"] for part in ("kernel", "bias")}

        torso = {f"hidden_{i}": layer(f"hidden_{i}") for i in range(len(config.hidden_sizes))}
        actor = {"torso": torso, "mean": layer("mean"), "log_std": mine["actor/log_std"]}
        moments = Normalizer(
            count=jnp.ones(()),
            mean=mine["normalizer/mean"],
            variance=mine["normalizer/std"] ** 2,
            rest=jnp.zeros((2, 1)),
        )
        features = moments.normalize(observation)
        return ppo_parts.nets(config, *SIZES).act({"actor": actor}, features, ()).mean

    mapped = jax.jit(jax.vmap(act, in_axes=(0, 1), out_axes=1))
    return np.asarray(mapped({name: jnp.asarray(array) for name, array in arrays.items()}, seen))


def _by_onnx(trained: Policy, seen: np.ndarray) -> np.ndarray:
    pytest.importorskip("onnx", reason="needs the package onnx")
    runtime = pytest.importorskip("onnxruntime", reason="needs the package onnxruntime")
    session = runtime.InferenceSession(
        export_onnx.render(trained), providers=["CPUExecutionProvider"]
    )
    fed = seen[:, 0] if trained.is_shared else seen
    (action,) = session.run(["action"], {"observation": fed})
    return action.reshape(*seen.shape[:2], -1)


def _by_c(trained: Policy, seen: np.ndarray, folder: Path) -> np.ndarray:
    outputs.write({folder / name: each for name, each in export_c.render(trained).items()})
    flags = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")
    built = [*("gcc", *flags, "policy.c", "-lm", "-o", "policy.so")]
    subprocess.run(built, cwd=folder, check=True)
    act = ctypes.CDLL(str(folder / "policy.so")).policy_action
    actions = trained.log_std.shape[1]
    action = np.zeros((*seen.shape[:2], actions), np.float32)
    into = ctypes.c_void_p
    width, step, size = seen.shape[2] * 4, 4 * actions, seen.shape[1]
    source, target = seen.ctypes.data, action.ctypes.data
    for i in range(seen.shape[0] * size):
        act(i % size, into(source + i * width), into(target + i * step))
    return action


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs Debian's package gcc")
@pytest.mark.parametrize("learners", [1, 3])
@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
def test_all_forms_of_a_policy_agree(activation: Activation, learners: int, tmp_path: Path) -> None:
    arrays = policies.arrays(hidden=AlgoConfig().hidden_sizes, learners=learners)
    given = several(learners)
    trained = saved(tmp_path / "policy.npz", arrays, activation=activation, **given)
    seen = policies.seen(trained, OBSERVATIONS)
    clipped = np.abs((seen - trained.mean) / trained.std) > 10
    assert 0.1 < clipped.mean() < 0.5
    expected = policy.act(trained, seen)
    assert 1 < np.abs(expected).max() < 20
    found = {
        "Flax": _by_flax(arrays, activation, seen),
        "ONNX": _by_onnx(trained, seen),
        "C": _by_c(trained, seen, tmp_path / "c"),
    }
    for name, action in found.items():
        assert action.dtype == np.float32
        np.testing.assert_allclose(action, expected, rtol=0, atol=TOLERANCE, err_msg=name)


STEPS, MEMORY = 1_000, 16


def _by_flax_steps(arrays: Arrays, seen: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Returns actions [T, R, U] of the Flax networks with a memory, for all steps in one call."""
    config = AlgoConfig(memory="gru", memory_size=MEMORY)

    def act(mine: dict[str, jax.Array], observation: jax.Array) -> jax.Array:
        def layer(name: str) -> dict[str, jax.Array]:
            return {part: mine[f"actor/{name}/{part}"] for part in ("kernel", "bias")}

        torso = {f"hidden_{i}": layer(f"hidden_{i}") for i in range(2)}
        memory = {part: layer(f"memory/{part}") for part in ("input", "recurrent")}
        heads = {"mean": layer("mean"), "log_std": mine["actor/log_std"]}
        actor = {"torso": torso, "memory": memory, **heads}
        moments = Normalizer(
            count=jnp.ones(()),
            mean=mine["normalizer/mean"],
            variance=mine["normalizer/std"] ** 2,
            rest=jnp.zeros((2, 1)),
        )
        features = moments.normalize(observation)
        none = jnp.zeros(MEMORY)
        nets = ppo_parts.nets(config, *SIZES)
        return nets.act({"actor": actor}, features, none, begins).mean

    mapped = jax.jit(jax.vmap(act, in_axes=(0, 1), out_axes=1))
    return np.asarray(mapped({name: jnp.asarray(array) for name, array in arrays.items()}, seen))


def _by_numpy_steps(trained: Policy, seen: np.ndarray, begins: np.ndarray) -> np.ndarray:
    found, memory = [], None
    for now, begun in zip(seen, begins, strict=True):
        memory = policy.begin(trained, now.shape[:-1]) if begun else memory
        memory, action = policy.step(trained, memory, now)
        found.append(action)
    return np.stack(found)


def _by_onnx_steps(trained: Policy, seen: np.ndarray, begins: np.ndarray) -> np.ndarray:
    pytest.importorskip("onnx", reason="needs the package onnx")
    runtime = pytest.importorskip("onnxruntime", reason="needs the package onnxruntime")
    content = export_onnx.render(trained)
    session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    found, rows = [], (1,) if trained.is_shared else (1, seen.shape[1])
    memory = np.zeros((*rows, trained.carried), np.float32)
    for now, begun in zip(seen, begins, strict=True):
        fed = {"observation": now.reshape(*rows, -1), "memory": memory * np.float32(not begun)}
        action, memory = session.run(["action", "memory_after"], fed)
        found.append(action.reshape(seen.shape[1], -1))
    return np.stack(found)


def _by_c_steps(trained: Policy, seen: np.ndarray, begins: np.ndarray, folder: Path) -> np.ndarray:
    outputs.write({folder / name: each for name, each in export_c.render(trained).items()})
    flags = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")
    subprocess.run(["gcc", *flags, "policy.c", "-lm", "-o", "policy.so"], cwd=folder, check=True)
    library, into = ctypes.CDLL(str(folder / "policy.so")), ctypes.c_void_p
    action = np.zeros((*seen.shape[:2], trained.log_std.shape[1]), np.float32)
    memory = np.ones((seen.shape[1], trained.carried), np.float32)
    for step, begun in enumerate(begins):
        for robot in range(seen.shape[1]):
            mine = into(memory[robot].ctypes.data)
            if begun:
                library.policy_begin(mine)
            where = into(seen[step, robot].ctypes.data), mine, into(action[step, robot].ctypes.data)
            library.policy_action(robot, *where)
    return action


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs Debian's package gcc")
@pytest.mark.parametrize("learners", [1, 3])
def test_all_forms_of_a_policy_that_remembers_agree_over_a_thousand_steps(
    learners: int, tmp_path: Path
) -> None:
    plain = policies.arrays(hidden=AlgoConfig().hidden_sizes, learners=learners)
    arrays, said = policies.recalling(plain, MEMORY, **several(learners))
    trained = saved(tmp_path / "policy.npz", arrays, **said)
    seen = policies.seen(trained, STEPS)
    begins = np.arange(STEPS) % 300 == 0
    expected = _by_numpy_steps(trained, seen, begins)
    found = {
        "Flax": _by_flax_steps(arrays, seen, begins),
        "ONNX": _by_onnx_steps(trained, seen, begins),
        "C": _by_c_steps(trained, seen, begins, tmp_path / "c"),
    }
    for name, action in found.items():
        assert action.dtype == np.float32
        # The memory forgets, so differences of single steps do not add up over a thousand steps.
        np.testing.assert_allclose(action, expected, rtol=0, atol=TOLERANCE, err_msg=name)
    # The memory matters: if it is reset at every step, the same observations give other actions.
    assert np.abs(expected - _by_numpy_steps(trained, seen, begins | True)).max() > 0.1
