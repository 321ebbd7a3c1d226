"""A policy as C99 for a microcontroller, with a self-test."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template

import numpy as np

from swarmjax import policy
from swarmjax.export import layout as export_layout
from swarmjax.export.layout import short
from swarmjax.policy import Policy

CASES = 32  # of the self-test, for each learner
_TEMPLATES = Path(__file__).resolve().parent / "templates" / "c"
_ACTIVATIONS = {
    "tanh": "tanhf(x[i])",
    "relu": "x[i] > 0.0f ? x[i] : 0.0f",
    # The logistic function by its identity with tanh, as NumPy's side computes it.
    "swish": "0.5f * x[i] * (1.0f + tanhf(0.5f * x[i]))",
}


def render(trained: Policy) -> dict[str, bytes]:
    """Makes the files of a policy.

    Args:
        trained: the policy.

    Returns:
        `policy.c`, `policy.h`, `policy_test.c`, `Makefile` and `README.md`.
    """
    values = _about(trained) | _layout(trained)
    code = values | _code(trained)
    return {
        "policy.h": _fill("policy.h", values),
        "policy.c": _fill("policy.c", code),
        "policy_test.c": _fill("policy_test.c", _cases(trained)),
        "Makefile": _fill("Makefile", {}),
        "README.md": _fill("README.md", values | {"observation": export_layout.table(trained)}),
    }


def _fill(name: str, values: dict[str, str]) -> bytes:
    return Template((_TEMPLATES / name).read_text()).substitute(values).encode()


def _about(trained: Policy) -> dict[str, str]:
    """What the comments and the constants say of a policy."""
    robot, task = trained.meta["robot"], trained.meta["task"]
    sizes, learners = _sizes(trained), len(trained.mean)
    weights = [part for layer in trained.layers for part in layer]
    arrays = [trained.mean, trained.std, trained.log_std, *weights]
    parameters = sum(array.size for array in arrays)
    several = f"{learners} policies, one for each robot."
    return {
        "digest": trained.digest,
        "kind": "All robots share it." if trained.is_shared else several,
        "trained": export_layout.trained_as(trained),
        "control_step": short(task["control_step"]),
        "control_step_f": number(task["control_step"]),
        "target_radius_f": number(task["target_radius"]),
        "holds": str(int(export_layout.holds(trained))),
        "observations": str(sizes[0]),
        "actions": str(sizes[-1]),
        "learners": str(learners),
        **{key: short(robot[key]) for key in ("wheel_radius", "track", "max_wheel_speed")},
        "parameters": f"{parameters:,}",
        "flash": f"{4 * parameters:,}",
        "stack": f"{2 * 4 * max(sizes[:-1]):,}",
    }


def _sizes(trained: Policy) -> list[int]:
    """The sizes of the layers, from the observation to the action."""
    return [trained.mean.shape[1], *(bias.shape[1] for _, bias in trained.layers)]


def _layout(trained: Policy) -> dict[str, str]:
    """Tables of the observation and the action, as lines of a comment."""
    action = trained.meta["action"]
    rows = zip(*(action[key] for key in ("names", "units", "low", "high")), strict=True)
    commanded = [f" *   {n:<20} {u:<8} {short(a)} to {short(b)}" for n, u, a, b in rows]
    observed = [
        f" *   [{i}] {one.name:<20} {one.unit:<8} offset {short(one.offset)}, "
        f"scale {short(one.scale)}"
        for i, one in enumerate(export_layout.entries(trained))
    ]
    return {"observation": "\n".join(observed), "action": "\n".join(commanded)}


def _code(trained: Policy) -> dict[str, str]:
    """What differs from policy to policy in its code."""
    robot, layout = trained.meta["robot"], trained.meta["observation"]
    sizes = _sizes(trained)
    return {
        "widest": str(max(sizes[:-1])),
        "offset": _values(layout["offset"]),
        "scale": _values(layout["scale"]),
        "limit": number(layout["limit"]),
        "arrays": "\n".join(_arrays(trained)),
        "activation": _ACTIVATIONS[trained.meta["activation"]],
        "layers": "\n".join(_calls(sizes)),
        "max_speed": number(trained.max_speed),
        "max_turn_rate": number(trained.max_turn_rate),
        **{key: number(robot[key]) for key in ("wheel_radius", "track", "max_wheel_speed")},
    }


def _arrays(trained: Policy) -> Iterable[str]:
    """Definitions of the arrays; a kernel is turned so that an output's weights follow closely."""
    yield _array("MEAN", trained.mean)
    yield _array("STD", trained.std)
    for i, (kernel, bias) in enumerate(trained.layers):
        yield _array(f"KERNEL_{i}", kernel.swapaxes(1, 2).reshape(len(kernel), -1))
        yield _array(f"BIAS_{i}", bias)
    yield _array("DEVIATION", np.exp(trained.log_std))


def _array(name: str, rows: np.ndarray) -> str:
    lines = [f"static const float {name}[POLICY_LEARNERS][{rows.shape[1]}] = {{"]
    lines += [f"{{\n{_values(row)}\n}}," for row in rows]
    return "\n".join([*lines, "};"])


def _calls(sizes: Sequence[int]) -> Iterable[str]:
    """The calls of the layers, to and fro between two buffers."""
    source, target = "a", "b"
    last = len(sizes) - 2
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        weights = f"KERNEL_{i}[learner], BIAS_{i}[learner], {inputs}, {outputs}"
        yield f"    layer({weights}, {source}, {'action' if i == last else target});"
        if i < last:
            yield f"    activate({target}, {outputs});"
        source, target = target, source


def _cases(trained: Policy) -> dict[str, str]:
    """Cases of the self-test, half of them beyond the clip, and what NumPy makes of them."""
    draw = np.random.default_rng(0)
    shape = (CASES, *trained.mean.shape)
    reach = np.where(np.arange(CASES) % 2, 1.5 * trained.meta["observation"]["limit"], 3.0)
    drawn = draw.uniform(-1, 1, shape) * reach[:, None, None]
    observation = (trained.mean + trained.std * drawn).astype(np.float32)
    action = policy.act(trained, observation)
    normal = draw.standard_normal(action.shape, np.float32)
    sample = policy.act(trained, observation, normal)

    def table(values: np.ndarray) -> str:
        rows = values.reshape(-1, values.shape[-1])
        return "\n".join(f"{{\n{_values(row)}\n}}," for row in rows)

    tables = {"observation": observation, "action": action, "normal": normal, "sample": sample}
    cases = CASES * len(trained.mean)
    return {"cases": str(cases)} | {name: table(values) for name, values in tables.items()}


def _values(row: Iterable[float]) -> str:
    """Writes numbers four to a line."""
    words = [number(value) for value in row]
    lines = [", ".join(words[i : i + 4]) for i in range(0, len(words), 4)]
    return ",\n".join(f"    {line}" for line in lines)


def number(value: float) -> str:
    """Writes a number so that C reads the very same float32: as a constant of C99.

    Args:
        value: rounded to float32.

    Returns:
        As few digits as tell it from its neighbours.
    """
    return f"{np.format_float_scientific(np.float32(value), trim='0')}f"
