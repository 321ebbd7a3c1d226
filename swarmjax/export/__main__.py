"""`python -m swarmjax.export run=DIR`: a checkpoint becomes `policy.npz`, ONNX, C or for Webots.

Usage: python -m swarmjax.export run=runs/NAME [format=onnx] [step=UPDATE] [seed=SEED] [out=FILE]
       python -m swarmjax.export policy=policy.npz format=c [out=FOLDER]

A run of several seeds gives `policy-seed0.npz` and so on, or that of one `seed`.
"""

import json
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmjax import command, compose, config, policy_file, provenance
from swarmjax.config import AlgoConfig, ConfigError, ExportConfig, RobotConfig, TrainConfig
from swarmjax.export import c, onnx, webots
from swarmjax.export import folder as export_folder
from swarmjax.ppo import learner as ppo
from swarmjax.ppo import normalizer
from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import CheckpointError, Leaves
from swarmjax.task import observation
from swarmjax.training import seeds

POLICY = "policy.npz"
_DRIVE = ("wheel_radius", "track", "max_wheel_speed")
# What each format is called where `out` does not say.
_NAMES = {"npz": POLICY, "onnx": "policy.onnx", "c": "policy_c", "webots": "swarmjax_epuck"}
# A controller of such a name would be imported in the place of what it or NumPy needs.
_IMPORTED = sys.stdlib_module_names | {"policy", "controller", "numpy"}


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
    """Describes a policy: its layout with units, the config it was trained with, versions.

    Args:
      trained: the run's config.
      update: that the policy is from, 0 or more.
      seed: of the policy.

    Returns:
      The `meta` of the `policy.npz` format, all of it but `format`, in SI units.
    """
    robot = trained.robot
    encoding = config.encoding(trained.task, trained.realism)
    return {
        "policy": trained.algo.policy,
        "learners": trained.learners,
        "activation": trained.algo.activation,
        "observation": observation.describe(encoding) | {"limit": ppo.OBSERVATION_LIMIT},
        "action": {
            "names": list(policy_file.ACTION_NAMES),
            "units": list(policy_file.ACTION_UNITS),
            "low": [0.0, -robot.max_turn_rate],
            "high": [robot.max_speed, robot.max_turn_rate],
        },
        "robot": {
            "preset": _robot_preset(robot),
            **{key: getattr(robot, key) for key in ("body", *_DRIVE)},
        },
        "sensors": {
            "preset": trained.realism.name,
            "response": trained.realism.infrared,
            "range": trained.task.sensor_range,
        },
        "task": {key: getattr(trained.task, key) for key in ("control_step", "target_radius")},
        "config": config.to_dict(trained),
        "versions": provenance.versions(),
        "update": update,
        "seed": seed,
    }


def _robot_preset(robot: RobotConfig) -> str:
    """Names the file of configs/robot/ that a robot's numbers are those of, or `custom`."""
    for name in compose.choices("robot"):
        if config.build(RobotConfig, compose.read_preset("robot", name)) == robot:
            return name
    return "custom"


def seed_path(path: Path, trained: TrainConfig, seed: int) -> Path:
    """Names the policy of a seed.

    Args:
      path: of the policy of a run of one seed.
      trained: the run's config.
      seed: one of the run's.

    Returns:
      `path`, or one beside it where there are several seeds.
    """
    return path if trained.seeds == 1 else path.with_stem(f"{path.stem}-seed{seed}")


def _squashed(arrays: dict[str, np.ndarray], algo: AlgoConfig) -> dict[str, np.ndarray]:
    """Writes an output of tanh as one more hidden layer, before a last one that changes nothing."""
    if algo.output == "linear":
        return arrays
    parts = ("kernel", "bias")
    last = {f"actor/hidden_{len(algo.hidden)}/{p}": arrays[f"actor/mean/{p}"] for p in parts}
    learners, actions = arrays["actor/mean/bias"].shape
    mean = np.tile(np.eye(actions, dtype=np.float32), (learners, 1, 1))
    zero = np.zeros((learners, actions), np.float32)
    return arrays | last | {"actor/mean/kernel": mean, "actor/mean/bias": zero}


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
    policy_file.write(path, _squashed(arrays, trained.algo), policy_meta(trained, update, seed))


def read_config(run: Path) -> dict:
    """Reads the config that a run directory was trained with.

    Args:
      run: the directory.

    Returns:
      The config as plain data, unchecked.

    Raises:
      ConfigError: if there is none, or it is no JSON object.
    """
    path = run / "config.json"
    try:
        found = json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(f"{run} is no run directory: it has no config.json.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read: {error}.") from None
    if not isinstance(found, dict):
        raise ConfigError(f"{path} is no run's config: it holds no JSON object.")
    return found


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = config.load_export(arguments)
    if settings.policy is not None:
        out = _target(settings, Path(settings.policy).parent)
        _convert(settings, Path(settings.policy), out)
        sys.stdout.write(f"{out}: the policy of {settings.policy}.\n")
        return 0
    run = Path(settings.run or "")
    trained = config.build(TrainConfig, read_config(run))
    targets = _targets(settings, trained)
    leaves, update, skipped = checkpoint.restore(run, settings.step)
    for sentence in skipped:
        sys.stderr.write(f"swarmjax.export: {sentence}: it was passed over.\n")
    for seed, out in targets.items():
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / POLICY
            write_policy(file, leaves, trained, update, seed)
            _convert(settings, file, out)
        sys.stdout.write(f"{out}: the policy of {run} after {update} updates.\n")
    return 0


def _targets(settings: ExportConfig, trained: TrainConfig) -> dict[int, Path]:
    """Says which seeds are exported, and where to."""
    every, seed = seeds.numbers(trained), settings.seed
    if seed is not None and seed not in every:
        several = f"seeds {every[0]} to {every[-1]}: give one of them."
        has = several if len(every) > 1 else f"seed {every[0]}: give {every[0]}."
        raise ConfigError(f"seed is {seed}, but {settings.run} was trained with {has}")
    out = _target(settings, Path(settings.run or ""))
    if settings.out and seed is not None:
        return {seed: out}
    return {k: seed_path(out, trained, k) for k in (every if seed is None else [seed])}


def _target(settings: ExportConfig, folder: Path) -> Path:
    """Where to, where there is one policy; what is there already is not looked at."""
    out = Path(settings.out) if settings.out else folder / _default(settings)
    if out.name in ("", ".."):
        raise ConfigError(f"out is {out}, which others use too: give a name of its own.")
    ending = Path(_NAMES[settings.format]).suffix
    if out.suffix != ending and ending:
        raise ConfigError(f"out is {out}, but format is {settings.format}: end it in {ending}.")
    if settings.format == "webots":
        _check_controller(out)
    return out


def _default(settings: ExportConfig) -> str:
    """What is written where `out` does not say; a `step` leaves the final policy alone."""
    name = Path(_NAMES[settings.format])
    return str(
        name if settings.step is None else name.with_stem(f"{name.stem}-step{settings.step}")
    )


def _check_controller(out: Path) -> None:
    """Refuses a folder whose name cannot be that of the module of a controller."""
    if not re.fullmatch(r"[A-Za-z_][\w-]*", out.name, re.ASCII):
        raise ConfigError(
            f"out is {out}, whose name is also the controller's: give letters, digits, _ and - "
            "only, as in swarmjax_epuck."
        )
    if out.name in _IMPORTED:
        raise ConfigError(
            f"out is {out}, whose name is also the controller's, and that of a module that it "
            "imports: give another, as in swarmjax_epuck."
        )


def _convert(settings: ExportConfig, source: Path, out: Path) -> None:
    """Writes a policy file in another form."""
    trained = policy_file.read(source)
    content = source.read_bytes()
    if settings.format == "npz":
        export_folder.write_file(out, content)
    elif settings.format == "onnx":
        export_folder.write_file(out, onnx.render(trained))
    elif settings.format == "c":
        export_folder.write_folder(out, c.render(trained))
    else:
        files = webots.render(trained, content, settings.sensors, out.name)
        export_folder.write_folder(out, files)


if __name__ == "__main__":
    sys.exit(command.run("export", main, ExportConfig, (CheckpointError,)))
