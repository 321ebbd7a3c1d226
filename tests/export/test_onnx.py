"""Checks that the ONNX file holds a valid model that describes its inputs and outputs."""

import json
from pathlib import Path

import numpy as np
import policies
import pytest
from policies import saved, several

from swarmjax import policy
from swarmjax.export import onnx as export_onnx
from swarmjax.task.observation import SIZE

onnx = pytest.importorskip("onnx", reason="needs the package onnx")
runtime = pytest.importorskip("onnxruntime", reason="needs the package onnxruntime")


@pytest.mark.parametrize("learners", [1, 3])
def test_the_model_is_sound_and_runs_any_batch(learners: int, tmp_path: Path) -> None:
    given = policies.arrays(learners=learners)
    trained = saved(tmp_path / "policy.npz", given, **several(learners))
    content = export_onnx.render(trained)
    model = onnx.load_from_string(content)
    onnx.checker.check_model(model, full_check=True)
    assert [(one.domain, one.version) for one in model.opset_import] == [("", 17)]
    session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    (port,) = session.get_inputs()
    assert (port.name, port.type) == ("observation", "tensor(float)")
    assert port.shape == (["batch", SIZE] if learners == 1 else ["batch", learners, SIZE])
    assert [out.name for out in session.get_outputs()] == ["action", "command"]
    for count in (2, 14):
        seen = policies.seen(trained, count)
        expected = policy.act(trained, seen)
        fed = seen[:, 0] if learners == 1 else seen
        action, command = session.run(None, {"observation": fed})
        # Sums of a few terms are added in another order; actions are below 4.
        np.testing.assert_allclose(action.reshape(expected.shape), expected, atol=2e-6)
        # A command has a range of up to 6.28 rad/s, and an action is off by 2e-6 in a range of 2.
        np.testing.assert_allclose(
            command.reshape(expected.shape), policy.command(trained, expected), atol=7e-6
        )


@pytest.mark.parametrize("learners", [1, 3])
def test_the_model_of_one_that_remembers_is_sound(learners: int, tmp_path: Path) -> None:
    given, said = policies.recalling(policies.arrays(learners=learners), 4, **several(learners))
    content = export_onnx.render(saved(tmp_path / "policy.npz", given, **said))
    onnx.checker.check_model(onnx.load_from_string(content), full_check=True)
    session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    rows = ["batch"] if learners == 1 else ["batch", learners]
    found = {port.name: port.shape for port in (*session.get_inputs(), *session.get_outputs())}
    assert found == {
        "observation": [*rows, SIZE],
        "memory": [*rows, 4],
        "action": [*rows, 2],
        "command": [*rows, 2],
        "memory_after": [*rows, 4],
    }


def test_the_metadata_are_those_of_the_policy(tmp_path: Path) -> None:
    trained = saved(tmp_path / "policy.npz")
    model = onnx.load_from_string(export_onnx.render(trained))
    found = {one.key: one.value for one in model.metadata_props}
    assert found.pop("digest") == trained.digest
    np.testing.assert_allclose(json.loads(found.pop("deviation")), np.exp(trained.log_std))
    assert {key: json.loads(value) for key, value in found.items()} == {
        key: trained.meta[key] for key in found
    }
    assert {"observation", "action", "robot", "sensors", "task", "config"} <= found.keys()
    assert model.producer_name == "swarmjax"
