"""`python -m swarmjax.export run=DIR`: a checkpoint becomes `policy.npz`, for NumPy alone.

Usage: python -m swarmjax.export run=runs/NAME [step=UPDATE] [seed=SEED] [out=FILE]

A run of several seeds gives `policy-seed0.npz` and so on, or that of one `seed`.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmjax import checkpoint, command, config, policy, provenance, seeds
from swarmjax.checkpoint import CheckpointError, Leaves
from swarmjax.config import ConfigError, ExportConfig, TrainConfig
from swarmjax.ppo import learner as ppo
from swarmjax.ppo import normalizer
from swarmjax.task import observation

POLICY = "policy.npz"


def policy_arrays(leaves: Leaves) -> dict[str, np.ndarray]:
    """Takes what a policy needs to act out of a checkpoint.

    Args:
      leaves: of the `TrainState` of one seed, as `checkpoint.to_leaves` names them.

    Returns:
      Arrays [L, ...] under the names of the `policy.npz` format.
    """
    prefix = "learners/params/actor/"
    actor = {
        "actor/" + name.removeprefix(prefix).removeprefix("torso/"): leaf
        for name, leaf in leaves.items()
        if name.startswith(prefix)
    }
    mean, variance = (leaves[f"learners/normalizer/{name}"] for name in ("mean", "variance"))
    std = np.maximum(np.sqrt(variance), normalizer.MIN_STD)
    return actor | {"normalizer/mean": mean, "normalizer/std": std}


def policy_meta(trained: TrainConfig, update: int, seed: int) -> dict:
    """Describes a policy: its layout with units, the config it was trained with, versions."""
    robot = trained.robot
    encoding = config.encoding(trained.task, trained.realism)
    return {
        "policy": trained.algo.policy,
        "learners": trained.learners,
        "activation": trained.algo.activation,
        "observation": observation.describe(encoding) | {"limit": ppo.OBSERVATION_LIMIT},
        "action": {
            "names": ["speed", "turn_rate"],
            "units": ["m/s", "rad/s"],
            "low": [0.0, -robot.max_turn_rate],
            "high": [robot.max_speed, robot.max_turn_rate],
        },
        "config": config.to_dict(trained),
        "versions": provenance.versions(),
        "update": update,
        "seed": seed,
    }


def policy_file(file: Path, trained: TrainConfig, seed: int) -> Path:
    """Names the file of a seed's policy: `file`, or one beside it where there are several seeds."""
    return file if trained.seeds == 1 else file.with_stem(f"{file.stem}-seed{seed}")


def write_policy(path: Path, leaves: Leaves, trained: TrainConfig, update: int, seed: int) -> None:
    """Writes the policy of one seed of a checkpoint to `path`.

    Args:
      path: the file.
      leaves: of a run, [N, ...] each.
      trained: the run's config.
      update: of the checkpoint.
      seed: one of the run's.

    Raises:
      CheckpointError: if the config is not the one that made the checkpoint.
    """
    lane = seeds.numbers(trained).index(seed)
    arrays = policy_arrays(checkpoint.of_seed(leaves, lane, trained.seeds))
    widths = tuple(
        arrays[f"actor/hidden_{i}/bias"].shape[1]
        for i in range(sum(name.endswith("/bias") for name in arrays) - 1)
    )
    found = (len(arrays["actor/log_std"]), widths)
    if found != (trained.learners, trained.algo.hidden):
        raise CheckpointError(
            f"the checkpoint holds {found[0]} learners of layers {list(widths)}, but the config "
            f"says {trained.learners} of {list(trained.algo.hidden)}: it is of another run."
        )
    policy.save(path, arrays, policy_meta(trained, update, seed))


def read_config(run: Path) -> dict:
    """Reads the config that a run directory was trained with.

    Raises:
      ConfigError: if there is none, or it is not JSON.
    """
    path = run / "config.json"
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(f"{run} is no run directory: it has no config.json.") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}.") from None


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = config.load_export(arguments)
    run = Path(settings.run)
    trained = config.build(TrainConfig, read_config(run))
    files = _files(settings, trained)
    leaves, update, skipped = checkpoint.restore(run, settings.step)
    for sentence in skipped:
        sys.stderr.write(f"swarmjax.export: {sentence}: it was passed over.\n")
    for seed, file in files.items():
        write_policy(file, leaves, trained, update, seed)
        sys.stdout.write(f"{file}: the policy of {run} after {update} updates.\n")
    return 0


def _files(settings: ExportConfig, trained: TrainConfig) -> dict[int, Path]:
    """Says which seeds are exported, and where to."""
    every, seed = seeds.numbers(trained), settings.seed
    if seed is not None and seed not in every:
        several = f"seeds {every[0]} to {every[-1]}: give one of them."
        has = several if len(every) > 1 else f"seed {every[0]}: give {every[0]}."
        raise ConfigError(f"seed is {seed}, but {settings.run} was trained with {has}")
    if settings.out and seed is not None:
        return {seed: Path(settings.out)}
    file = Path(settings.out) if settings.out else Path(settings.run) / POLICY
    return {k: policy_file(file, trained, k) for k in (every if seed is None else [seed])}


if __name__ == "__main__":
    sys.exit(command.run("export", main, ExportConfig, (CheckpointError,)))
