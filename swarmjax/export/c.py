"""Writes a policy as C99 for a microcontroller, with a self-test."""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from swarmjax import policy
from swarmjax.export import layout
from swarmjax.policy import Policy

CASES = 32  # cases of the self-test for each learner
_FILES = ("policy.h", "policy.c", "policy_test.c", "Makefile", "README.md")
_ACTIVATIONS = {
    "tanh": "tanhf(x[i])",
    "relu": "x[i] > 0.0f ? x[i] : 0.0f",
    # The logistic function expressed by tanh, as the NumPy code computes it.
    "swish": "0.5f * x[i] * (1.0f + tanhf(0.5f * x[i]))",
}


def render(trained: Policy) -> dict[str, bytes]:
    """Makes the C files of a policy.

    Args:
      trained: the policy.

    Returns:
      `policy.c`, `policy.h`, `policy_test.c`, `Makefile` and `README.md`.
    """
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).resolve().parent / "templates" / "c"),
        autoescape=False,  # not HTML; a policy's names have only plain letters
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters |= {"float32": number, "floats": floats, "short": layout.short}
    widths = [trained.mean.shape[1], *(bias.shape[1] for _, bias in trained.layers)]
    arrays = _arrays(trained)
    values: dict[str, Any] = {
        "policy": trained,
        "meta": trained.meta,
        "trained": layout.trained_as(trained),
        "entries": layout.entries(trained),
        "table": layout.table(trained),
        "activation": _ACTIVATIONS[trained.meta["activation"]],
        "memory": trained.carried,
        "sizes": list(itertools.pairwise(widths)),
        "widest": max([*widths[:-1], widths[-2] + trained.carried]),
        "arrays": arrays,
        "parameters": sum(array.size for array in arrays.values()),
        "cases": _cases(trained),
    }
    return {name: templates.get_template(name).render(values).encode() for name in _FILES}


def _arrays(trained: Policy) -> dict[str, np.ndarray]:
    """Lists the arrays [L, ...]. Kernels are transposed: the weights of an output are adjacent."""
    layers = {f"KERNEL_{i} BIAS_{i}": layer for i, layer in enumerate(trained.layers)}
    if trained.memory is not None:
        (seen, seen_bias, recalled, recalled_bias) = trained.memory
        layers["SEEN_KERNEL SEEN_BIAS"] = seen, seen_bias
        layers["RECALLED_KERNEL RECALLED_BIAS"] = recalled, recalled_bias
    arrays = {"MEAN": trained.mean, "STD": trained.std}
    for names, (kernel, bias) in layers.items():
        flat = kernel.swapaxes(1, 2).reshape(len(kernel), -1)
        arrays |= zip(names.split(), (flat, bias), strict=True)
    return arrays | {"DEVIATION": np.exp(trained.log_std)}


def _cases(trained: Policy) -> dict[str, np.ndarray]:
    """Makes the self-test's cases, and NumPy's results for them.

    In half of the cases, observations may exceed the limit to which the policy clips them.
    """
    draw = np.random.default_rng(0)
    shape = (CASES, *trained.mean.shape)
    reach = np.where(np.arange(CASES) % 2, 1.5 * trained.meta["observation"]["limit"], 3.0)
    drawn = draw.uniform(-1, 1, shape) * reach[:, None, None]
    observation = (trained.mean + trained.std * drawn).astype(np.float32)
    action = _play(trained, observation)
    normal = draw.standard_normal(action.shape, np.float32)
    sample = action + np.exp(trained.log_std) * normal
    tables = {"OBSERVATION": observation, "ACTION": action, "NORMAL": normal, "SAMPLE": sample}
    return {name: table.reshape(-1, table.shape[-1]) for name, table in tables.items()}


def _play(trained: Policy, observation: np.ndarray) -> np.ndarray:
    """Computes the most likely actions for successive observations. Clears the memory halfway."""
    actions, memory = [], None
    for i, seen in enumerate(observation):
        if i in (0, CASES // 2):
            memory = policy.begin(trained, seen.shape[:-1])
        memory, action = policy.step(trained, memory, seen)
        actions.append(action)
    return np.stack(actions)


def floats(row: Iterable[float]) -> str:
    """Writes numbers four to a line."""
    words = [number(value) for value in row]
    lines = [", ".join(words[i : i + 4]) for i in range(0, len(words), 4)]
    return ",\n".join(f"    {line}" for line in lines)


def number(value: float) -> str:
    """Writes a number as a C99 constant that C reads as exactly the same float32.

    Args:
      value: the number, rounded to float32.

    Returns:
      A text with the fewest digits that distinguish the number from other float32 numbers.
    """
    return f"{np.format_float_scientific(np.float32(value), trim='0')}f"
