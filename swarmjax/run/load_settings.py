"""Makes a run's settings from command-line words, and for a resumed run also from its directory."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from swarmjax import extension
from swarmjax.config import ConfigError, build, check_text, files, inherit, reading, show, to_dict
from swarmjax.config.section import build_stored
from swarmjax.curriculum import axes
from swarmjax.curriculum.config import check_mode
from swarmjax.ppo.config import resolve
from swarmjax.run import recipes
from swarmjax.run.directory import CONFIG, MAY_CHANGE
from swarmjax.run.settings import TrainConfig
from swarmjax.task import pieces, stage_files
from swarmjax.task.goals import load as goals

AUTO = "auto"  # `resume` accepts this word in place of a directory

# The keys that a resumed run accepts. All other keys determine what the run has computed so far.
_RESUME_KEYS = (*("run.*" if key == "run" else key for key in MAY_CHANGE), "extensions")

# The keys of `algo` that a run with `init_from` takes from the run that it starts from.
NETWORK_KEYS = (
    *("policy", "network", "hidden_sizes", "memory", "memory_size"),
    *("critic", "activation", "mean_activation"),
)


def from_stored(stored: Mapping[str, Any], where: str = "") -> TrainConfig:
    """Rebuilds the configuration that a run directory or a policy file holds.

    Its key `extensions` is left out: only a command line or Python may name code to execute.

    Args:
      stored: the result of `to_dict`.
      where: the prefix of its keys in messages.

    Raises:
      ConfigError: if the configuration is invalid.
    """
    own = {key: value for key, value in stored.items() if key != "extensions"}
    return build_stored(TrainConfig, own, where)


def read_config(run: Path) -> dict:
    """Reads the config that a run directory was trained with.

    Args:
      run: the directory.

    Returns:
      The config as plain data, unchecked.

    Raises:
      ConfigError: if the directory has no config, or the config is not a JSON object.
    """
    path = run / CONFIG
    check_text("the run directory", str(run))
    if not path.exists():
        raise ConfigError(f"{run} is not a run directory: it has no {CONFIG}.")
    found = reading.read_json(path)
    if not isinstance(found, dict):
        raise ConfigError(f"{path} is not a run's config: it holds no JSON object.")
    return found


def load_train(
    overrides: Sequence[str], *, stages: Sequence[dict[str, Any]] | None = None
) -> TrainConfig:
    """Makes the configuration of `swarmjax.train` from its `key=value` words.

    Args:
      overrides: the `key=value` words.
      stages: plain data of the stages; None if the words name the stages.

    Raises:
      ConfigError: if a word, a choice, a file or a value is invalid.
    """
    return load_as(TrainConfig, overrides, stages)


def load_as[C: TrainConfig](
    cls: type[C], overrides: Sequence[str], stages: Sequence[dict[str, Any]] | None = None
) -> C:
    """Does what `load_train` does, for a command that has all keys of `swarmjax.train`."""

    def complete(mapping: dict[str, Any], chosen: dict[str, str]) -> dict[str, Any]:
        if stages is None:
            found = stage_files.expand(mapping.get("stage", {}), chosen["stage"])
            mapping = mapping | {"stage_name": stage_files.name_of(chosen["stage"])}
        else:
            found = list(stages)
        options = mapping.get("curriculum", {})
        if options.get("axes"):
            found = _grid(found, options["axes"])
            mapping = mapping | {"curriculum": {"mode": "frontier"} | options}
        return mapping | {"stage": found}

    given = recipes.expand(cls, overrides)
    return settle(files.load(cls, [*_inherited(cls, given), *given], complete))


def _grid(stages: list[dict[str, Any]], along: Any) -> list[dict[str, Any]]:
    """Returns the stages that `curriculum.axes` makes out of a single stage."""
    if len(stages) > 1:
        raise ConfigError(
            f"curriculum.axes needs one stage, but stage lists {len(stages)}: give a single stage, "
            f"as in stage={stages[-1]['name']}."
        )
    if not isinstance(along, Mapping):
        raise ConfigError(
            f"curriculum.axes is {show(along)}: give the values of each axis, as in "
            "curriculum.axes.robots=[2,5,10]."
        )
    return axes.expand(stages[0], along)


def _inherited(cls: type[TrainConfig], typed: Sequence[str]) -> list[str]:
    """Returns the words that a run with `init_from` takes from the run that it starts from.

    These words set robot, task, realism and the shape of the networks. `typed` overrides them.
    """
    source = files.parse(cls, typed).get("init_from")
    if not isinstance(source, str):
        return []
    try:
        held = from_stored(read_config(Path(source)))
    except ConfigError:  # `warm_start.read` reports it later, when the run begins
        return []
    others = [key for key in to_dict(held.algo) if key not in NETWORK_KEYS]
    if held.algo.memory == "none" or any(
        word.startswith(("algo.memory=", "algo=")) for word in typed
    ):
        others.append("memory_size")  # the typed words choose the memory, and so its size
    return [
        *inherit.group_words(cls, "robot", held.robot, typed),
        *inherit.group_words(cls, "task", held.task, typed),
        *inherit.group_words(cls, "algo", held.algo, typed, skip=others),
        *inherit.preset_words(cls, "realism", held.realism, typed),
    ]


def settle[C: TrainConfig](settings: C) -> C:
    """Adds the full names and digests of the extension pieces that a run uses.

    Args:
      settings: the config. If it already holds digests, they come from a stored run.

    Raises:
      ConfigError: if a piece is missing, or differs from the one that the stored run used.
    """
    found = extension.load(settings.extensions)
    extension.check_needs(settings.pieces, found, "the stored run")
    used = pieces.choose(found, settings.task, settings.stage)
    network = resolve(settings.algo, found.networks)
    check_mode(settings.curriculum.mode, found.curricula)
    goals.load(settings.task, settings.robot, found.goals)  # raises if there is no such goal
    if settings.extensions is None:
        return settings
    drawn = {stage.level for stage in settings.stage}
    chosen = found._replace(
        rewards=tuple(piece for piece, _ in used.terms),
        observations=used.observations,
        levels=tuple(each for each in found.levels if each.name in drawn),
        networks=tuple(each for each in found.networks if each.name == network),
        curricula=tuple(each for each in found.curricula if each.name == settings.curriculum.mode),
        goals=tuple(each for each in found.goals if each.name == settings.task.goal),
    )
    return replace(
        settings,
        task=pieces.resolve(found, settings.task),
        algo=replace(settings.algo, network=network),
        pieces=chosen.digests(),
    )


def load_resume(stored: Mapping[str, Any], overrides: Sequence[str]) -> TrainConfig:
    """Makes the configuration with which a stored run goes on in its own directory.

    The stored `run.stop_after` and `run.distributed` are dropped: they applied only to that start.

    Args:
      stored: configuration of the run, as `to_dict` returns it.
      overrides: `key=value` words, only for keys that may change.

    Raises:
      ConfigError: if another key is given, or a stored or new value is invalid.
    """
    words = files.parse(TrainConfig, overrides)
    for key, value in words.items():
        if not _may_change(key):
            allowed = ", ".join(_RESUME_KEYS)
            raise ConfigError(
                f"{key}={show(value, quote='')} cannot be given: a resumed run keeps its settings, "
                f"and only {allowed} may change."
            )
    given = files.nest(words)
    kept = to_dict(from_stored(stored, "stored "))
    typed = given.get("run", {})
    here = given.get("resume") or typed.get("dir")
    if typed.get("dir") and Path(typed["dir"]) != Path(here):
        raise ConfigError(
            f"run.dir is {show(typed['dir'])}, but resume is {show(here)}, and a resumed run "
            "continues in its own directory: leave run.dir out."
        )
    run = kept["run"] | {"stop_after": None, "distributed": False} | typed | {"dir": here}
    devices = given.get("devices", kept["devices"])
    streams = _kept_streams(kept["streams"], devices, kept["seeds_by"])
    return settle(build(TrainConfig, kept | {"streams": streams} | given | {"run": run}))


def _may_change(key: str) -> bool:
    return key in _RESUME_KEYS or key.startswith("run.")


def _kept_streams(streams: int | None, devices: Any, seeds_by: str) -> int | None:
    """Returns a resumed run's number of streams: the stored one if it fits the run's devices."""
    by_seeds = seeds_by == "devices"
    fits = isinstance(devices, int) and streams and (by_seeds or streams % devices == 0)
    return streams if fits else None


def load_run(
    overrides: Sequence[str], stages: Sequence[dict[str, Any]] | None = None
) -> TrainConfig:
    """Makes the configuration of a new run or, with `resume=`, of a run that goes on.

    Args:
      overrides: `key=value` words; with `resume`, only for keys that may change.
      stages: plain data of the stages of a new run; None if the words name the stages.

    Raises:
      ConfigError: if a word, a choice, a file or a value is invalid.
    """
    words = [word for word in overrides if word.startswith("resume=")]
    resumed = files.parse(TrainConfig, words).get("resume")
    if resumed == AUTO:
        return _go_on_or_begin([word for word in overrides if word not in words], stages)
    if not resumed:
        return load_train(overrides, stages=stages)
    return load_resume(read_config(Path(resumed)), overrides)


def _go_on_or_begin(words: Sequence[str], stages: Sequence[dict[str, Any]] | None) -> TrainConfig:
    """Makes the configuration for `resume=auto`: it resumes the run in `run.dir` or begins one."""
    typed = load_train(words, stages=stages)
    if typed.run.dir is None:
        raise ConfigError("resume is auto, but run.dir is missing: give run.dir=DIR too.")
    run = Path(typed.run.dir)
    if not (run / CONFIG).exists():
        return typed
    stored = from_stored(read_config(run), "stored ")
    extension.check_needs(stored.pieces, extension.load(typed.extensions), str(run))
    _check_unchanged(run, to_dict(typed), to_dict(stored))
    streams = typed.streams
    if "streams" not in files.parse(TrainConfig, words):
        streams = _kept_streams(stored.streams, typed.devices, typed.seeds_by)
    return replace(
        typed, resume=str(run), streams=streams, run=replace(typed.run, id=stored.run.id)
    )


def _check_unchanged(run: Path, typed: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Refuses to resume a run with settings that differ from its own, and names these keys."""
    mine, its = (
        files.flatten({k: v for k, v in each.items() if k not in MAY_CHANGE})
        for each in (typed, stored)
    )
    changed = [key for key in mine if mine[key] != its.get(key)]
    if changed:
        shown = ", ".join(f"{k} is {show(mine[k])}, not {show(its.get(k))}" for k in changed[:3])
        raise ConfigError(
            f"resume is auto, but {run} holds a run with other settings: {shown}; only "
            f"{', '.join(_RESUME_KEYS)} may change, so use that run's settings or another run.dir."
        )
