"""Policies written by hand, for the tests of all who read or export them."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax import epuck, policy, policy_file
from swarmjax.policy import Policy
from swarmjax.task import observation

Arrays = dict[str, np.ndarray]

EMBODIMENT = {
    "robot": {
        "preset": "planar",
        "body": "planar",
        "wheel_radius": epuck.WHEEL_RADIUS,
        "track": epuck.TRACK,
        "max_wheel_speed": epuck.MAX_WHEEL_SPEED,
    },
    "sensors": {"preset": "ideal", "response": "ideal", "range": epuck.SENSOR_RANGE},
    "task": {"control_step": 0.032, "target_radius": 0.05},
    "seed": 0,
}


def meta(**changes: Any) -> dict[str, Any]:
    """All that `policy_file.write` takes beside the arrays of `arrays`."""
    full = {
        "policy": "shared",
        "learners": 1,
        "activation": "tanh",
        "observation": observation.describe("metric") | {"limit": 10.0},
        "action": {
            "names": ["speed", "turn_rate"],
            "units": ["m/s", "rad/s"],
            "low": [0.0, -epuck.MAX_TURN_RATE],
            "high": [epuck.MAX_SPEED, epuck.MAX_TURN_RATE],
        },
        **copy.deepcopy(EMBODIMENT),
        "config": {"seed": 3},
        "versions": {"swarmjax": "0.1.0"},
        "update": 17,
    }
    return full | changes


def several(learners: int) -> dict[str, Any]:
    """What `meta` says of so many learners."""
    return {"policy": "shared" if learners == 1 else "independent", "learners": learners}


def arrays(hidden: tuple[int, ...] = (4, 3), learners: int = 1, seed: int = 0) -> Arrays:
    """Networks whose actions are some units large and depend on all that is observed.

    The normaliser's mean and deviation are those of a robot between walls: centimetres of
    infrared, decimetres of distance, radians of bearing.
    """
    draw = np.random.default_rng(seed)
    sizes = (observation.SIZE, *hidden, 2)
    names = [*(f"hidden_{i}" for i in range(len(hidden))), "mean"]
    found: Arrays = {}
    for name, inner, outer in zip(names, sizes, sizes[1:], strict=False):
        kernel = draw.normal(size=(learners, inner, outer)) / np.sqrt(inner)
        found[f"actor/{name}/kernel"] = kernel
        found[f"actor/{name}/bias"] = 0.1 * draw.normal(size=(learners, outer))
    found["actor/log_std"] = draw.normal(size=(learners, 2))
    mean = np.array([*[0.035] * epuck.SENSORS, 0.5, 0.0])
    std = np.array([*[0.008] * epuck.SENSORS, 0.3, 1.2])
    found["normalizer/mean"] = mean * draw.uniform(0.8, 1.2, (learners, len(mean)))
    found["normalizer/std"] = std * draw.uniform(0.8, 1.2, (learners, len(std)))
    return {name: array.astype(np.float32) for name, array in found.items()}


def saved(path: Path, given: Arrays | None = None, **changes: Any) -> Policy:
    """Writes a policy and reads it again."""
    policy_file.write(path, arrays() if given is None else given, meta(**changes))
    return policy_file.read(path)


def forge(path: Path, given: Arrays, said: Any, digest: str | None = None) -> None:
    """Writes a file without any check, its digest right unless one is given."""
    text = said if isinstance(said, str) else json.dumps(said)
    whole = given | {"meta": np.array(text)}
    whole["digest"] = np.array(policy.digest(whole) if digest is None else digest)
    np.savez(path, allow_pickle=False, **whole)


def seen(trained: Policy, count: int, seed: int = 0) -> np.ndarray:
    """Draws observations [count, R, O] of a metric policy, R its learners.

    Half lie in their physical ranges: 0 to 4 cm of infrared, 0 to 2.2 m, -pi to pi. The others
    reach half as far again as the normaliser's limit, where it clips them.
    """
    draw = np.random.default_rng(seed)
    shape = (count // 2, *trained.mean.shape)
    low = np.array([*[0.0] * epuck.SENSORS, 0.0, -np.pi])
    high = np.array([*[epuck.SENSOR_RANGE] * epuck.SENSORS, 2.2, np.pi])
    far = 1.5 * trained.meta["observation"]["limit"] * draw.uniform(-1, 1, shape)
    drawn = [draw.uniform(low, high, shape), trained.mean + trained.std * far]
    return np.concatenate(drawn).astype(np.float32)
