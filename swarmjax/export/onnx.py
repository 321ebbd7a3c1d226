"""Writes a policy as an ONNX graph, from the observation to the action and the command.

This module needs the package `onnx`, which the extra `onnx` installs. The model's metadata describe
the layout of the observation.
"""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.policy import Policy

if TYPE_CHECKING:
    from onnx import NodeProto, TensorProto

# The operations used here have not changed since this version of 2021, so old runtimes can read the
# file.
OPSET = 17
IR_VERSION = 8


class _Graph:
    """The operations of a graph, in order, and its constants."""

    def __init__(self) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """Adds a constant and returns its name."""
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, operation: str, *inputs: str, name: str = "", **options: Any) -> str:
        """Adds an operation and returns the name of its result, which is its last output."""
        from onnx import helper

        result = name or f"value_{len(self.nodes)}"
        outputs = ["", result] if operation == "GRU" else [result]
        self.nodes.append(helper.make_node(operation, list(inputs), outputs, **options))
        return result


def render(policy: Policy) -> bytes:
    """Makes the model of a policy.

    Args:
      policy: the policy.

    Returns:
      The bytes of an ONNX file. Its input `observation` is [B, O] for a shared policy, else
      [B, R, O], where R is the number of learners; `meta["observation"]` of the policy describes
      the entries. Its outputs are `action` ([..., U], as `policy.act` returns it without `normal`)
      and `command` ([..., U], as `policy.command` returns it, in m/s and rad/s). A policy with
      memory has a second input `memory` and a third output `memory_after`, both [..., H]. `memory`
      must be zero at the start of an episode.

    Raises:
      ConfigError: if the package `onnx` is not installed.
    """
    try:
        from onnx import TensorProto, helper
    except ImportError:
        raise ConfigError(
            "format is onnx, but the package onnx is not installed: run uv sync --extra onnx."
        ) from None
    graph, actions = _graph(policy), len(policy.meta["action"]["names"])
    leading = ["batch"] if policy.is_shared else ["batch", len(policy.mean)]
    takes = {"observation": policy.mean.shape[1]}
    gives = {"action": actions, "command": actions}
    if policy.carried:
        takes, gives = takes | {"memory": policy.carried}, gives | {"memory_after": policy.carried}
    inputs, outputs = (
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [*leading, size])
            for name, size in sizes.items()
        ]
        for sizes in (takes, gives)
    )
    made = helper.make_graph(graph.nodes, "policy", inputs, outputs, graph.constants)
    operators = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(
        made, producer_name="swarmjax", ir_version=IR_VERSION, opset_imports=operators
    )
    helper.set_model_props(model, _properties(policy))
    return model.SerializeToString()


def _graph(policy: Policy) -> _Graph:
    """Writes the operations of `policy.act` and `policy.command`, learner by learner."""
    graph = _Graph()
    names = ("action", "memory_after") if policy.carried else ("action",)
    results = [_learner(graph, policy, i) for i in range(len(policy.mean))]
    for name, values in zip(names, zip(*results, strict=True), strict=True):
        if policy.is_shared:
            graph.add("Identity", values[0], name=name)
        else:
            axis = graph.constant([1], np.int64)
            rows = [graph.add("Unsqueeze", value, axis) for value in values]
            graph.add("Concat", *rows, axis=1, name=name)
    low, high = (np.array(policy.meta["action"][key]) for key in ("low", "high"))
    x = graph.add("Clip", "action", graph.constant(-1.0), graph.constant(1.0))
    x = graph.add("Mul", x, graph.constant((high - low) / 2))
    graph.add("Add", x, graph.constant((high + low) / 2), name="command")
    return graph


def _learner(graph: _Graph, policy: Policy, i: int) -> tuple[str, ...]:
    """Adds the networks of learner i; returns its action [B, U] and perhaps its memory [B, H]."""

    def mine(name: str) -> str:
        """Selects learner i's part of an input."""
        if policy.is_shared:
            return name
        return graph.add("Gather", name, graph.constant(i, np.int64), axis=1)

    def dense(x: str, layer: tuple[np.ndarray, np.ndarray]) -> str:
        return graph.add("Gemm", x, *(graph.constant(part[i]) for part in layer))

    limit = policy.meta["observation"]["limit"]
    x = graph.add("Sub", mine("observation"), graph.constant(policy.mean[i]))
    x = graph.add("Div", x, graph.constant(policy.std[i]))
    x = graph.add("Clip", x, graph.constant(-limit), graph.constant(limit))
    for layer in policy.layers[:-1]:
        x = _activate(graph, policy.meta["activation"], dense(x, layer))
    if policy.memory is None:
        return (dense(x, policy.layers[-1]),)
    memory = _remember(graph, [part[i] for part in policy.memory], x, mine("memory"))
    x = graph.add("Concat", x, memory, axis=-1)
    return dense(x, policy.layers[-1]), memory


def _remember(graph: _Graph, parts: list[np.ndarray], x: str, memory: str) -> str:
    """Adds the gated recurrent unit of `policy.step`; returns the memory [B, H] after it."""

    def ordered(part: np.ndarray) -> np.ndarray:
        """Puts reset, update and candidate gate [..., 3 H] into ONNX's order: update first."""
        reset, update, candidate = np.split(part, 3, axis=-1)
        return np.concatenate([update, reset, candidate], axis=-1)

    seen, seen_bias, recalled, recalled_bias = map(ordered, parts)
    first = graph.constant([0], np.int64)  # axis of time in x, and of directions in other inputs
    after = graph.add(
        "GRU",
        graph.add("Unsqueeze", x, first),
        graph.constant(seen.T[None]),
        graph.constant(recalled.T[None]),
        graph.constant(np.concatenate([seen_bias, recalled_bias])[None]),
        "",  # all sequences have the same length
        graph.add("Unsqueeze", memory, first),
        hidden_size=len(recalled),
        linear_before_reset=1,
    )
    return graph.add("Squeeze", after, first)


def _activate(graph: _Graph, activation: str, x: str) -> str:
    if activation == "swish":
        return graph.add("Mul", x, graph.add("Sigmoid", x))
    return graph.add({"tanh": "Tanh", "relu": "Relu"}[activation], x)


def _properties(policy: Policy) -> dict[str, str]:
    """Describes the model's inputs and outputs for its metadata."""
    keys = ("observation", "action", "robot", "sensors", "task", "policy", "learners", "config")
    described = {key: policy.meta[key] for key in (*keys, "versions", "update", "seed")}
    text = {key: json.dumps(value, sort_keys=True) for key, value in described.items()}
    deviation = np.exp(policy.log_std).tolist()
    return text | {"deviation": json.dumps(deviation), "digest": policy.digest}
