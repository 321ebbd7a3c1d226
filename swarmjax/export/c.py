"""Writes a policy as C99 for a microcontroller, with a self-test."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from swarmjax import policy
from swarmjax.export import layout as export_layout
from swarmjax.export.layout import short
from swarmjax.policy import Policy

CASES = 32  # cases of the self-test for each learner
_TEMPLATES = Path(__file__).resolve().parent / "templates" / "c"
_ACTIVATIONS = {
    "tanh": "tanhf(x[i])",
    "relu": "x[i] > 0.0f ? x[i] : 0.0f",
    # The logistic function expressed by tanh, as the NumPy code computes it.
    "swish": "0.5f * x[i] * (1.0f + tanhf(0.5f * x[i]))",
}

_MEMORY_RESET = """        if (i % (CASES / 2) < POLICY_LEARNERS) {
            policy_begin(&memory[i % POLICY_LEARNERS]);
        }
"""


def render(trained: Policy) -> dict[str, bytes]:
    """Makes the C files of a policy.

    Args:
      trained: the policy.

    Returns:
      `policy.c`, `policy.h`, `policy_test.c`, `Makefile` and `README.md`.
    """
    values = _about(trained) | _layout(trained) | _memory(trained)
    files = {
        "policy.h": values,
        "policy.c": values | _code(trained),
        "policy_test.c": values | _cases(trained),
        "Makefile": {},
        "README.md": values | {"observation": export_layout.table(trained)},
    }
    return {name: _fill(name, each).encode() for name, each in files.items()}


def _fill(name: str, values: Mapping[str, object]) -> str:
    return Template((_TEMPLATES / name).read_text()).substitute(values)


def _about(trained: Policy) -> dict[str, Any]:
    """Returns the texts and constants of a policy that fill the templates."""
    robot, task = trained.meta["robot"], trained.meta["task"]
    sizes, learners = _sizes(trained), len(trained.mean)
    weights = [part for layer in trained.layers for part in layer]
    arrays = [trained.mean, trained.std, trained.log_std, *weights]
    arrays += trained.memory or ()
    parameters = sum(array.size for array in arrays)
    several = f"{learners} policies, one for each robot."
    return {
        "digest": trained.digest,
        "kind": "All robots share it." if trained.is_shared else several,
        "trained": export_layout.trained_as(trained),
        "control_step": short(task["control_step"]),
        "control_step_f": number(task["control_step"]),
        "target_radius_f": number(task["target_radius"]),
        "holds": int(task["arrival"] == "hold"),
        "observations": trained.mean.shape[1],
        "actions": sizes[-1],
        "learners": learners,
        **{key: short(robot[key]) for key in ("wheel_radius", "track", "max_wheel_speed")},
        "parameters": f"{parameters:,}",
        "flash": f"{4 * parameters:,}",
        "stack": f"{2 * 4 * (_widest(trained) + 3 * trained.carried):,}",
    }


def _sizes(trained: Policy) -> list[int]:
    """Returns the sizes of the layers, from the input of the first one to the action."""
    return [trained.mean.shape[1], *(bias.shape[1] for _, bias in trained.layers)]


def _widest(trained: Policy) -> int:
    """Returns the largest input size of a layer."""
    *inputs, last, _ = _sizes(trained)
    return max([*inputs, last + trained.carried])


def _memory(trained: Policy) -> dict[str, Any]:
    """Returns the texts and code about the memory; empty for a policy without one."""
    size = trained.carried
    if not size:
        names = ("type", "parameter", "code", "begin", "reset", "argument", "word")
        return dict.fromkeys((f"memory_{name}" for name in names), "") | {
            "kept": "It keeps nothing in RAM between calls.",
            "memory_start": "",
        }
    return {
        "memory_type": _fill("memory.h", {"size": size}),
        "memory_parameter": "PolicyMemory *memory, ",
        "memory_code": _fill("memory.c", {"features": _sizes(trained)[-2]}),
        "memory_begin": "    PolicyMemory memory[POLICY_LEARNERS];\n",
        "memory_reset": _MEMORY_RESET,
        "memory_argument": "&memory[i % POLICY_LEARNERS], ",
        "memory_word": "&memory, ",
        "kept": f"A robot keeps {4 * size} bytes between calls, in a\n`PolicyMemory`.",
        "memory_start": "At the start of an episode:\n\n    PolicyMemory memory;\n\n"
        "    policy_begin(&memory);\n\n",
    }


def _layout(trained: Policy) -> dict[str, Any]:
    """Makes tables of the observation and the action as lines of a comment."""
    action = trained.meta["action"]
    rows = zip(*(action[key] for key in ("names", "units", "low", "high")), strict=True)
    commanded = [f" *   {n:<20} {u:<8} {short(a)} to {short(b)}" for n, u, a, b in rows]
    observed = [
        f" *   [{i}] {name:<20} {unit:<8} offset {short(offset)}, scale {short(scale)}"
        for i, (name, unit, offset, scale) in enumerate(export_layout.entries(trained))
    ]
    return {"observation": "\n".join(observed), "action": "\n".join(commanded)}


def _code(trained: Policy) -> dict[str, Any]:
    """Returns the parts of the code that differ between policies."""
    robot, layout = trained.meta["robot"], trained.meta["observation"]
    return {
        "widest": _widest(trained),
        "offset": _values(layout["offset"]),
        "scale": _values(layout["scale"]),
        "limit": number(layout["limit"]),
        "arrays": "\n".join(_arrays(trained)),
        "tanh": ", and nothing if the activation is relu" if trained.memory is None else "",
        "activation": _ACTIVATIONS[trained.meta["activation"]],
        "layers": "\n".join(_calls(_sizes(trained), trained.carried)),
        "max_speed": number(trained.max_speed),
        "max_turn_rate": number(trained.max_turn_rate),
        **{key: number(robot[key]) for key in ("wheel_radius", "track", "max_wheel_speed")},
    }


def _arrays(trained: Policy) -> Iterable[str]:
    """Yields the arrays; kernels are transposed so that an output's weights are adjacent."""
    yield _array("MEAN", trained.mean)
    yield _array("STD", trained.std)
    layers: dict[str, Sequence[np.ndarray]]
    layers = {f"KERNEL_{i} BIAS_{i}": layer for i, layer in enumerate(trained.layers)}
    if trained.memory is not None:
        layers["SEEN_KERNEL SEEN_BIAS"] = trained.memory[:2]
        layers["RECALLED_KERNEL RECALLED_BIAS"] = trained.memory[2:]
    for names, (kernel, bias) in layers.items():
        kernel_name, bias_name = names.split()
        yield _array(kernel_name, kernel.swapaxes(1, 2).reshape(len(kernel), -1))
        yield _array(bias_name, bias)
    yield _array("DEVIATION", np.exp(trained.log_std))


def _array(name: str, rows: np.ndarray) -> str:
    lines = [f"static const float {name}[POLICY_LEARNERS][{rows.shape[1]}] = {{"]
    lines += [f"{{\n{_values(row)}\n}}," for row in rows]
    return "\n".join([*lines, "};"])


def _calls(sizes: Sequence[int], recalled: int) -> Iterable[str]:
    """Yields the layers' calls, with two buffers in turn; the memory comes before the last one."""
    source, target = "a", "b"
    last = len(sizes) - 2
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        if i == last and recalled:
            yield f"    remember(learner, {source}, memory->recalled);"
            yield "    for (unsigned i = 0; i < POLICY_MEMORY; i++) {"
            yield f"        {source}[{inputs} + i] = memory->recalled[i];"
            yield "    }"
            inputs += recalled  # the head also takes the memory
        weights = f"KERNEL_{i}[learner], BIAS_{i}[learner], {inputs}, {outputs}"
        yield f"    layer({weights}, {source}, {'action' if i == last else target});"
        if i < last:
            yield f"    activate({target}, {outputs});"
        source, target = target, source


def _cases(trained: Policy) -> dict[str, Any]:
    """Makes the self-test's cases, half of them beyond the clip, and NumPy's results for them."""
    draw = np.random.default_rng(0)
    shape = (CASES, *trained.mean.shape)
    reach = np.where(np.arange(CASES) % 2, 1.5 * trained.meta["observation"]["limit"], 3.0)
    drawn = draw.uniform(-1, 1, shape) * reach[:, None, None]
    observation = (trained.mean + trained.std * drawn).astype(np.float32)
    action = _play(trained, observation)
    normal = draw.standard_normal(action.shape, np.float32)
    sample = action + np.exp(trained.log_std) * normal

    def table(values: np.ndarray) -> str:
        rows = values.reshape(-1, values.shape[-1])
        return "\n".join(f"{{\n{_values(row)}\n}}," for row in rows)

    tables = {"observation": observation, "action": action, "normal": normal, "sample": sample}
    cases = CASES * len(trained.mean)
    return {"cases": cases} | {name: table(values) for name, values in tables.items()}


def _play(trained: Policy, observation: np.ndarray) -> np.ndarray:
    """Computes the most likely actions for successive observations; clears memory halfway."""
    actions, memory = [], None
    for i, seen in enumerate(observation):
        if i in (0, CASES // 2):
            memory = policy.begin(trained, seen.shape[:-1])
        memory, action = policy.step(trained, memory, seen)
        actions.append(action)
    return np.stack(actions)


def _values(row: Iterable[float]) -> str:
    """Writes numbers four to a line."""
    words = [number(value) for value in row]
    lines = [", ".join(words[i : i + 4]) for i in range(0, len(words), 4)]
    return ",\n".join(f"    {line}" for line in lines)


def number(value: float) -> str:
    """Writes a number as a C99 constant that C reads as exactly the same float32.

    Args:
      value: the number, rounded to float32.

    Returns:
      The fewest digits that distinguish it from its neighbours.
    """
    return f"{np.format_float_scientific(np.float32(value), trim='0')}f"
