"""Writes a policy as an ONNX graph, from the observation to the action and the command.

Needs the package `onnx`, an extra. The model's metadata describe the layout of the observation.
"""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.policy import Policy

if TYPE_CHECKING:
    from onnx import NodeProto, TensorProto

# The operations here have not changed since this version of 2021, so old runtimes read the file.
OPSET = 17
IR_VERSION = 8


class _Graph:
    """A chain of operations; each takes the result of the one before."""

    def __init__(self, start: str) -> None:
        """Starts at the graph's input."""
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []
        self.value = start

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """Adds a constant and returns its name."""
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def then(self, operation: str, *others: str, name: str | None = None, **options: Any) -> str:
        """Adds an operation on the newest value and `others`; returns the name of its result."""
        from onnx import helper

        result = name or f"value_{len(self.nodes)}"
        node = helper.make_node(operation, [self.value, *others], [result], **options)
        self.nodes.append(node)
        self.value = result
        return result


def render(policy: Policy) -> bytes:
    """Makes the model of a policy.

    Args:
      policy: the policy.

    Returns:
      The bytes of an ONNX file. Its input `observation` is [B, O] for a shared policy, else
      [B, R, O], where R is the number of learners; `meta["observation"]` of the policy describes
      the entries. Its outputs are `action` ([..., U], as `policy.act` without `normal`) and
      `command` (as `policy.command`: m/s and rad/s). A policy with memory has a second input
      `memory` and a third output `memory_after`: [..., H]. `memory` is zero at the start of an
      episode.

    Raises:
      ConfigError: if the package `onnx` is not installed.
    """
    try:
        from onnx import TensorProto, helper
    except ImportError:
        raise ConfigError(
            "format is onnx, but the package onnx is not installed: run uv sync --extra onnx."
        ) from None
    graph = _graph(policy)
    leading = ["batch"] if policy.is_shared else ["batch", len(policy.mean)]

    def port(name: str, size: int) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [*leading, size])

    actions = len(policy.meta["action"]["names"])
    recalled = [policy.carried] if policy.carried else []
    made = helper.make_graph(
        graph.nodes,
        "policy",
        [
            port("observation", policy.mean.shape[1]),
            *(port("memory", n) for n in recalled),
        ],
        [
            port("action", actions),
            port("command", actions),
            *(port("memory_after", n) for n in recalled),
        ],
        graph.constants,
    )
    operators = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(
        made, producer_name="swarmjax", ir_version=IR_VERSION, opset_imports=operators
    )
    helper.set_model_props(model, _properties(policy))
    return model.SerializeToString()


def _graph(policy: Policy) -> _Graph:
    """Chains the operations of `policy.act` and `policy.command`."""
    graph = _Graph("observation")
    limit = policy.meta["observation"]["limit"]
    shared = policy.is_shared

    def rows(array: np.ndarray) -> str:
        """Adds a constant that broadcasts over the rows of a batch; robots come first."""
        return graph.constant(array[0] if shared else array[:, None])

    if not shared:
        graph.then("Transpose", perm=[1, 0, 2])  # robots first, so that each gets its own matrix
    graph.then("Sub", rows(policy.mean))
    graph.then("Div", rows(policy.std))
    graph.then("Clip", graph.constant(-limit), graph.constant(limit))
    for i, (kernel, bias) in enumerate(policy.layers):
        last = i == len(policy.layers) - 1
        if last and policy.memory is not None:
            _remember(graph, policy.memory, shared=shared)
        graph.then("MatMul", graph.constant(kernel[0] if shared else kernel))
        graph.then("Add", rows(bias), name="action" if last and shared else None)
        if not last:
            _activate(graph, policy.meta["activation"])
    if not shared:
        graph.then("Transpose", perm=[1, 0, 2], name="action")
    _command(graph, policy)
    return graph


def _command(graph: _Graph, policy: Policy) -> None:
    """Scales the action to the command."""
    graph.then("Clip", graph.constant(-1.0), graph.constant(1.0))
    low, high = (np.array(policy.meta["action"][key]) for key in ("low", "high"))
    graph.then("Mul", graph.constant((high - low) / 2))
    graph.then("Add", graph.constant((high + low) / 2), name="command")


def _remember(graph: _Graph, parts: tuple[np.ndarray, ...], *, shared: bool) -> None:
    """Adds the gated recurrent unit of `policy.step` and appends its state to the features."""
    size, features = parts[2].shape[1], graph.value
    graph.value = "memory"
    old = graph.value if shared else graph.then("Transpose", perm=[1, 0, 2])

    def product(source: str, weights: tuple[np.ndarray, ...], gate: int) -> str:
        """Computes the product of one gate: 0 reset, 1 update, 2 candidate."""
        mine = slice(gate * size, (gate + 1) * size)
        kernel, bias = weights[0][..., mine], weights[1][..., mine]
        graph.value = source
        graph.then("MatMul", graph.constant(kernel[0] if shared else kernel))
        return graph.then("Add", graph.constant(bias[0] if shared else bias[:, None]))

    def opened(gate: int) -> str:
        """Computes the reset or update gate, within 0..1."""
        seen = product(features, parts[:2], gate)
        product(old, parts[2:], gate)
        graph.then("Add", seen)
        return graph.then("Sigmoid")

    reset, update = opened(0), opened(1)
    seen = product(features, parts[:2], 2)
    product(old, parts[2:], 2)
    graph.then("Mul", reset)
    graph.then("Add", seen)
    fresh = graph.then("Tanh")
    graph.value = old
    graph.then("Sub", fresh)
    graph.then("Mul", update)
    after = graph.then("Add", fresh, name="memory_after" if shared else None)
    if not shared:
        graph.then("Transpose", perm=[1, 0, 2], name="memory_after")
    graph.value = features
    graph.then("Concat", after, axis=-1)


def _activate(graph: _Graph, activation: str) -> None:
    before = graph.value
    if activation == "swish":
        graph.then("Sigmoid")
        graph.then("Mul", before)
    else:
        graph.then({"tanh": "Tanh", "relu": "Relu"}[activation])


def _properties(policy: Policy) -> dict[str, str]:
    """Describes the model's inputs and outputs for its metadata."""
    keys = ("observation", "action", "robot", "sensors", "task", "policy", "learners", "config")
    described = {key: policy.meta[key] for key in (*keys, "versions", "update", "seed")}
    text = {key: json.dumps(value, sort_keys=True) for key, value in described.items()}
    deviation = np.exp(policy.log_std).tolist()
    return text | {"deviation": json.dumps(deviation), "digest": policy.digest}
