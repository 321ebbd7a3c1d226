"""`python -m swarmjax.export run=DIR`: exports a checkpoint as `policy.npz`, ONNX, C or for Webots.

A run with several seeds gives `policy-seed0.npz` and so on; the key `seed` exports only one seed.

Examples:
  # write the policy of the newest checkpoint again
  python -m swarmjax.export run=runs/first
  # the policy of an older checkpoint
  python -m swarmjax.export run=runs/first step=100
  # one seed of several
  python -m swarmjax.export run=runs/first seed=3
  # for ONNX Runtime
  python -m swarmjax.export policy=policy.npz format=onnx
  # C99 for a robot's firmware
  python -m swarmjax.export policy=policy.npz format=c out=firmware/policy_c
  # a controller for Webots
  python -m swarmjax.export policy=policy.npz format=webots
"""

import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from swarmjax import command, epuck, outputs, policy_file
from swarmjax.config import ConfigError, files, show
from swarmjax.evaluate import trained_settings
from swarmjax.export import c, onnx, webots, webots_controller
from swarmjax.export.config import ExportConfig
from swarmjax.policy import PolicyError
from swarmjax.run import checkpoint
from swarmjax.run.checkpoint import CheckpointError
from swarmjax.run.load_settings import from_stored, read_config, settle
from swarmjax.run.policy_export import POLICY, seed_path, write_policy
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import response

# Name of the export in each format if `out` is not given.
_NAMES = {"npz": POLICY, "onnx": "policy.onnx", "c": "policy_c", "webots": "swarmjax_epuck"}


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(ExportConfig, arguments)
    if settings.policy is not None:
        out = _target(settings, Path(settings.policy).parent)
        convert(settings, Path(settings.policy), out)
        sys.stdout.write(f"{out}: the policy of {settings.policy}.\n")
        return 0
    run = Path(settings.run or "")
    trained = from_stored(read_config(run))
    trained = settle(replace(trained, extensions=settings.extensions))
    targets = _targets(settings, trained)
    leaves, update, skipped, *_ = checkpoint.find(run, settings.step)
    for sentence in skipped:
        sys.stderr.write(f"swarmjax.export: {sentence} and was skipped.\n")
    for seed, out in targets.items():
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / POLICY
            write_policy(file, leaves, trained, update, seed)
            convert(settings, file, out)
        sys.stdout.write(f"{out}: the policy of {run} after {update} updates.\n")
    return 0


def _targets(settings: ExportConfig, trained: TrainConfig) -> dict[int, Path]:
    """Returns the path to write, for each seed to export."""
    every, seed = trained.numbers, settings.seed
    if seed is not None and seed not in every:
        several = f"seeds {every[0]} to {every[-1]}: give one of them."
        has = several if len(every) > 1 else f"seed {every[0]}: give {every[0]}."
        raise ConfigError(f"seed is {seed}, but {settings.run} was trained with {has}")
    out = _target(settings, Path(settings.run or ""))
    if settings.out and seed is not None:
        return {seed: out}
    return {k: seed_path(out, trained, k) for k in (every if seed is None else [seed])}


def _target(settings: ExportConfig, folder: Path) -> Path:
    """Returns the path to write if one policy is exported. The path may already exist."""
    out = Path(settings.out) if settings.out else folder / _default(settings)
    if out.name in ("", ".."):
        raise ConfigError(
            f"out is {out}, which does not end with a name: add the name of a file or folder."
        )
    ending = Path(_NAMES[settings.format]).suffix
    if out.suffix != ending and ending:
        raise ConfigError(f"out is {out}, but format is {settings.format}: end out with {ending}.")
    return out


def _default(settings: ExportConfig) -> str:
    """Returns the export's default name. With `step`, it differs from the final policy's name."""
    name = Path(_NAMES[settings.format])
    return str(
        name if settings.step is None else name.with_stem(f"{name.stem}-step{settings.step}")
    )


def convert(settings: ExportConfig, source: Path, out: Path) -> None:
    """Writes a policy file in another format.

    Args:
      settings: the export's settings, which give the format.
      source: the policy file.
      out: the file or folder to write.

    Raises:
      PolicyError: if the policy file is unsound.
      ConfigError: if the format cannot hold the policy, or `out` cannot be written.
    """
    meta, content = policy_file.read_meta(source), source.read_bytes()
    if settings.format == "npz":
        outputs.write({out: content})
        return
    # Refuses numbers that `policy_file` does not check.
    trained_settings.trained(meta, str(source))
    _check_form(meta, settings.format)
    trained = policy_file.read(source)
    if settings.format == "onnx":
        outputs.write({out: onnx.render(trained)})
        return
    if settings.format == "c":
        made = c.render(trained)
    else:
        made = webots.render(trained, content, out.name)
    outputs.write({out / name: each for name, each in made.items()})


def _check_form(meta: Mapping[str, Any], form: str) -> None:
    """Checks that a format can hold a policy, and that Webots can measure the policy's inputs."""
    if "network" in meta:
        raise PolicyError(
            f"format is {form}, but only npz can hold the policy's network "
            f"{show(meta['network'])}: give format=npz, or train with algo.network=mlp."
        )
    if form != "webots":
        return
    poses = meta["sensors"].get("poses", epuck.SENSOR_POSES)
    if [*map(tuple, poses)] != [*epuck.SENSOR_POSES]:
        raise PolicyError(
            "format is webots, whose controller drives an e-puck, but the policy's robot has "
            f"{len(poses)} other sensors: give format=c or onnx, and write your own controller."
        )
    goal = meta["task"].get("goal", "navigate")
    if goal != "navigate" or meta["task"].get("target_speed"):
        raise PolicyError(
            f"format is webots, whose world has targets that stay, but the policy's goal is {goal} "
            "with targets that move: give format=c or onnx, and write your own controller."
        )
    known = webots_controller.QUANTITIES
    unknown = [name for name in meta["observation"]["names"] if name not in known]
    if unknown:
        raise PolicyError(
            f"format is webots, but the policy observes {', '.join(unknown)}, which the controller "
            "cannot measure: give format=c or onnx, and write your own controller."
        )
    _check_range(meta)


def _check_range(meta: Mapping[str, Any]) -> None:
    """Checks that the policy needs no distances beyond the reach of Webots' infrared sensors."""
    reach, farthest = meta["sensors"]["range"], response.REACH["webots"]
    if meta["observation"]["encoding"] == "metric" and reach > farthest:
        raise ConfigError(
            "format is webots, but the policy was trained with infrared sensors that reach "
            f"{reach:g} m, and those of Webots measure distances only to {farthest:g} m: train "
            f"with robot.sensor_range={epuck.SENSOR_RANGE:g}, or give format=c or onnx."
        )


if __name__ == "__main__":
    sys.exit(command.run("export", main, ExportConfig, (CheckpointError,)))
