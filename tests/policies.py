"""Builds policies by hand, for tests of the code that reads or exports them."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
from entries import by_name

from swarmjax import epuck, policy, policy_file
from swarmjax.export import webots_controller
from swarmjax.policy import Policy
from swarmjax.task import observation

Arrays = dict[str, np.ndarray]
Names = tuple[str, ...]

EMBODIMENT = {
    "robot": {
        "preset": "planar",
        "body": "planar",
        "wheel_radius": epuck.WHEEL_RADIUS,
        "track": epuck.TRACK,
        "max_wheel_speed": epuck.MAX_WHEEL_SPEED,
    },
    "sensors": {"preset": "ideal", "response": "ideal", "range": epuck.SENSOR_RANGE},
    "task": {"control_step": 0.032, "target_radius": 0.05, "arrival": "latch"},
    "realism": {"name": "ideal", "infrared": "ideal"},
    "stages": [],
    "extensions": {},
    "seed": 0,
}


def observed(
    encoding: observation.Encoding = "metric", names: Names = observation.NAMES
) -> dict[str, Any]:
    """Returns the `observation` part of `meta` for observations with only these entries."""
    full = observation.describe(encoding)
    at = [full["names"].index(name) for name in names]
    parts = {key: [full[key][i] for i in at] for key in ("names", "units", "offset", "scale")}
    return full | parts | {"limit": 10.0}


def meta(**changes: Any) -> dict[str, Any]:
    """Returns the `meta` that `policy_file.write` takes with the arrays of `arrays`."""
    full = {
        "policy": "shared",
        "learners": 1,
        "activation": "tanh",
        "observation": observed(),
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


def remembering(given: Arrays, size: int, seed: int = 1) -> Arrays:
    """Returns these networks with a memory of `size` numbers, a further input of the last layer."""
    draw = np.random.default_rng(seed)
    kernel = given["actor/mean/kernel"]
    learners, width, actions = kernel.shape
    found = dict(given)
    for part, inner in (("input", width), ("recurrent", size)):
        drawn = draw.normal(size=(learners, inner, 3 * size)) / np.sqrt(inner)
        found[f"actor/memory/{part}/kernel"] = drawn.astype(np.float32)
        bias = 0.3 * draw.normal(size=(learners, 3 * size))
        found[f"actor/memory/{part}/bias"] = bias.astype(np.float32)
    more = draw.normal(size=(learners, size, actions)).astype(np.float32)
    return found | {"actor/mean/kernel": np.concatenate([kernel, more], axis=1)}


def recalling(given: Arrays, size: int, **said: Any) -> tuple[Arrays, dict[str, Any]]:
    """Returns these networks with a memory of `size` numbers, and their `meta`."""
    return remembering(given, size), said | {"memory": {"kind": "gru", "size": size}}


def several(learners: int) -> dict[str, Any]:
    """Returns the entries of `meta` for this number of learners."""
    return {"policy": "shared" if learners == 1 else "independent", "learners": learners}


def arrays(
    hidden: tuple[int, ...] = (4, 3),
    learners: int = 1,
    seed: int = 0,
    names: Names = observation.NAMES,
) -> Arrays:
    """Returns networks whose actions are a few units large and depend on every observed entry.

    The normaliser's mean and deviation are those of a robot between walls: centimetres for
    infrared, decimetres for distance, radians for bearing.
    """
    draw = np.random.default_rng(seed)
    sizes = (len(names), *hidden, 2)
    layers = [*(f"hidden_{i}" for i in range(len(hidden))), "mean"]
    found: Arrays = {}
    for name, inner, outer in zip(layers, sizes, sizes[1:], strict=False):
        kernel = draw.normal(size=(learners, inner, outer)) / np.sqrt(inner)
        found[f"actor/{name}/kernel"] = kernel
        found[f"actor/{name}/bias"] = 0.1 * draw.normal(size=(learners, outer))
    found["actor/log_std"] = draw.normal(size=(learners, 2))
    mean = by_name(names, infrared=0.035, distance=0.5, bearing=0.0, other=0.0)
    std = by_name(names, infrared=0.008, distance=0.3, bearing=1.2, other=1.0)
    found["normalizer/mean"] = mean * draw.uniform(0.8, 1.2, (learners, len(mean)))
    found["normalizer/std"] = std * draw.uniform(0.8, 1.2, (learners, len(std)))
    return {name: array.astype(np.float32) for name, array in found.items()}


def saved(path: Path, given: Arrays | None = None, **changes: Any) -> Policy:
    """Writes a policy and reads it again."""
    policy_file.write(path, arrays() if given is None else given, meta(**changes))
    return policy_file.read(path)


def saved_for_webots(path: Path) -> Policy:
    """Writes and reads a policy that observes only what the Webots controller can measure."""
    names = webots_controller.QUANTITIES
    return saved(path, arrays(names=names), observation=observed(names=names))


def forge(path: Path, given: Arrays, said: Any, digest: str | None = None) -> None:
    """Writes a file without any check; the digest is correct unless one is given."""
    text = said if isinstance(said, str) else json.dumps(said)
    whole = given | {"meta": np.array(text)}
    whole["digest"] = np.array(policy.digest(whole) if digest is None else digest)
    np.savez(path, allow_pickle=False, **whole)


def seen(trained: Policy, count: int, seed: int = 0) -> np.ndarray:
    """Draws observations [count, R, O] for a metric policy with R learners.

    Half of the observations lie in their physical ranges: infrared 0 to 4 cm, distance 0 to 2.2 m,
    bearing -pi to pi, other entries -1 to 1. The other half reach up to 1.5 times the normaliser's
    limit, so that some are clipped.
    """
    draw = np.random.default_rng(seed)
    mean, std = trained.mean, trained.std
    shape = (count // 2, *mean.shape)
    names = tuple(trained.meta["observation"]["names"])
    low = by_name(names, infrared=0.0, distance=0.0, bearing=-np.pi, other=-1.0)
    high = by_name(names, infrared=epuck.SENSOR_RANGE, distance=2.2, bearing=np.pi, other=1.0)
    far = 1.5 * trained.meta["observation"]["limit"] * draw.uniform(-1, 1, shape)
    drawn = [draw.uniform(low, high, shape), mean + std * far]
    return np.concatenate(drawn).astype(np.float32)
