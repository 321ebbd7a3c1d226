"""Exports a checkpoint to `policy.npz`: weights, normaliser, layout and training config."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax import extension, policy_file, provenance
from swarmjax.config import inherit, to_dict
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import MIN_STD, OBSERVATION_LIMIT
from swarmjax.run.checkpoint import Leaves
from swarmjax.run.settings import TrainConfig
from swarmjax.task import observation, pieces
from swarmjax.task.config import resolve_encoding

POLICY = "policy.npz"


_LOCAL = ("run", "resume", "init_from")
_TASK = ("control_step", "target_radius", "goal", "target_speed", "arrival", "step_limit")


def policy_arrays(leaves: Leaves) -> dict[str, np.ndarray]:
    """Extracts the arrays that a policy needs to act.

    Args:
      leaves: arrays of one seed's `TrainState`, as `checkpoint.to_leaves` names them.

    Returns:
      Arrays [L, ...] under the names of the `policy.npz` format.
    """
    prefix = "learners/params/actor/"
    actor = {
        _array_name(name.removeprefix(prefix)): leaf
        for name, leaf in leaves.items()
        if name.startswith(prefix) and not name.startswith(prefix + "guess/")  # only for training
    }
    mean, variance = (leaves[f"learners/normalizer/{name}"] for name in ("mean", "variance"))
    std = np.maximum(np.sqrt(variance), MIN_STD)
    return actor | {"normalizer/mean": mean, "normalizer/std": std}


def _array_name(name: str) -> str:
    """Returns the name in the file for an array of the actor or of an extension's network."""
    inner = name.removeprefix("torso/")
    own = inner != name and not re.fullmatch(r"hidden_\d+/(kernel|bias)", inner)
    return f"network/{inner}" if own else f"actor/{inner}"


def policy_meta(trained: TrainConfig, update: int, seed: int) -> dict:
    """Describes a policy: its layout with units, its training config, and versions.

    Args:
      trained: the run's config.
      update: number of the update that the policy comes from, at least 0.
      seed: seed of the policy.

    Returns:
      The `meta` of the `policy.npz` format without its key `format`, in SI units.
    """
    robot = trained.robot
    encoding = resolve_encoding(trained.task, trained.realism)
    chosen = pieces.choose(extension.load(trained.extensions), trained.task, trained.stage)
    described = observation.describe(encoding, chosen.observations, len(robot.sensor_poses))
    algo = trained.algo
    optional: dict[str, Any] = {"network": algo.network} if _has_own_network(algo) else {}
    if algo.memory != "none":
        optional["memory"] = {"kind": algo.memory, "size": algo.memory_size}
    return optional | {
        "policy": algo.policy,
        "learners": trained.learners,
        "activation": algo.activation,
        "observation": described | {"limit": OBSERVATION_LIMIT},
        "action": {
            "names": list(policy_file.ACTION_NAMES),
            "units": list(policy_file.ACTION_UNITS),
            "low": [0.0, -robot.max_turn_rate],
            "high": [robot.max_speed, robot.max_turn_rate],
        },
        "robot": {
            "preset": inherit.preset_of("robot", robot),
            **{k: v for k, v in to_dict(robot).items() if not k.startswith("sensor_")},
        },
        "sensors": {
            "preset": inherit.preset_of("realism", trained.realism),
            "response": trained.realism.infrared,
            "range": robot.sensor_range,
            "poses": [list(pose) for pose in robot.sensor_poses],
            "height": robot.sensor_height,
            "tilt": robot.sensor_tilt,
            "table": [list(point) for point in robot.sensor_response],
        },
        "task": {key: getattr(trained.task, key) for key in _TASK}
        | {"observations": [piece.name for piece in chosen.observations]},
        "realism": to_dict(trained.realism),
        "stages": [to_dict(stage) for stage in trained.stage],
        "extensions": trained.pieces,
        # Leaves out keys that concern only the machine of the run, such as paths.
        "config": {k: v for k, v in to_dict(trained).items() if k not in _LOCAL},
        "versions": provenance.versions(),
        "update": update,
        "seed": seed,
    }


def _has_own_network(algo: AlgoConfig) -> bool:
    """Returns whether the network is an extension's."""
    return algo.network not in (None, "mlp")


def seed_path(path: Path, trained: TrainConfig, seed: int) -> Path:
    """Returns the path of a seed's policy.

    Args:
      path: path of the policy in a run with one seed.
      trained: the run's config.
      seed: a seed of the run.

    Returns:
      `path`, or a path with the seed in its name if the run has several seeds.
    """
    return path if trained.seeds == 1 else path.with_stem(f"{path.stem}-seed{seed}")


def _squashed(arrays: dict[str, np.ndarray], algo: AlgoConfig) -> dict[str, np.ndarray]:
    """Turns a tanh output into one more hidden layer, followed by an identity output layer."""
    if algo.mean_activation == "linear":
        return arrays
    parts, count = ("kernel", "bias"), 0 if _has_own_network(algo) else len(algo.hidden_sizes)
    last = {f"actor/hidden_{count}/{p}": arrays[f"actor/mean/{p}"] for p in parts}
    learners, actions = arrays["actor/mean/bias"].shape
    mean = np.tile(np.eye(actions, dtype=np.float32), (learners, 1, 1))
    zero = np.zeros((learners, actions), np.float32)
    return arrays | last | {"actor/mean/kernel": mean, "actor/mean/bias": zero}


def write_policy(path: Path, leaves: Leaves, trained: TrainConfig, update: int, seed: int) -> None:
    """Writes the policy of one seed of a checkpoint to `path`.

    Args:
      path: the file.
      leaves: [N, ...] arrays of a run's checkpoint.
      trained: the run's config.
      update: number of the checkpoint's update.
      seed: a seed of the run.
    """
    lane = trained.numbers.index(seed)
    arrays = policy_arrays({name: leaf[lane] for name, leaf in leaves.items()})
    policy_file.write(path, _squashed(arrays, trained.algo), policy_meta(trained, update, seed))
