"""The settings of a training run, and how to read them from its directory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from swarmjax import extension, words
from swarmjax.config import (
    ConfigError,
    Section,
    about,
    build,
    files,
    inherit,
    reading,
    section,
    show,
    to_dict,
)
from swarmjax.config.section import MAX_COUNT, modernise
from swarmjax.ppo.config import AlgoConfig, resolve
from swarmjax.run import recipes
from swarmjax.run.directory import CONFIG, MAY_CHANGE
from swarmjax.task import mutation, pieces, stage_files
from swarmjax.task.config import check_realism
from swarmjax.task.stage_config import make_room
from swarmjax.training.config import ProgramConfig

# Most arenas of all seeds with run.episodes=true. With more arenas, thousands of episodes end per
# second.
MOST_LOGGED = 8192
AUTO = "auto"  # `arenas` accepts this word in place of a number


# The keys that a resumed run accepts. All other keys determine what the run has computed so far.
_RESUME_KEYS = tuple("run.*" if key == "run" else key for key in MAY_CHANGE)


@dataclass(frozen=True, kw_only=True)
class RunConfig(Section):
    """Where a run is written, and how often."""

    id: str | None = field(
        default=None, metadata=about("random id, drawn when the run begins", derived=True)
    )
    dir: str | None = field(
        default=None, metadata=about("run directory; null: runs/<date>-<time>-<stage>-seed<seed>")
    )
    chunk: int | Literal["all", "auto"] = field(
        default="auto", metadata=about("updates per call of the compiled program", 1, MAX_COUNT)
    )
    checkpoint_minutes: float = field(
        default=1.0, metadata=about("minutes between checkpoints; 0: after every chunk", 0.0)
    )
    checkpoint_share: float = field(
        default=0.1,
        metadata=about("share of the budget between checkpoints; 0: by time only", 0.0, 1.0),
    )
    keep_checkpoints: int = field(
        default=2,
        metadata=about("how many of the newest checkpoints to keep, plus the best", 1, MAX_COUNT),
    )
    checkpoint_arenas: bool = field(
        default=True,
        metadata=about(
            "save arenas in checkpoints; false: small files, and a resumed run draws new arenas"
        ),
    )
    stop_after: int | None = field(
        default=None,
        metadata=about("updates after which the run saves and stops", 0, MAX_COUNT),
    )
    tensorboard: bool = field(default=True, metadata=about("write TensorBoard events"))
    wandb: str | None = field(
        default=None,
        metadata=about("Weights & Biases project to log to; needs the extra wandb"),
    )
    wandb_mode: Literal["offline", "online"] = field(
        default="offline",
        metadata=about("offline: write to the run directory for `wandb sync`; online: send to W&B"),
    )
    episodes: bool = field(
        default=False, metadata=about("write each episode, robot by robot, to episodes.jsonl")
    )
    coordinator: Literal["auto"] | str | None = field(
        default=None,
        metadata=about(
            "HOST:PORT of the first of several processes; auto: taken from Slurm, Open MPI or "
            "Kubernetes; null: a single process"
        ),
    )
    processes: int | None = field(
        default=None, metadata=about("number of processes [coordinator=HOST:PORT]", 1, 2**16)
    )
    process: int | None = field(
        default=None,
        metadata=about("index of this process, from 0 [coordinator=HOST:PORT]", 0, 2**16),
    )
    deterministic: bool = field(
        default=False, metadata=about("make results on a GPU bit-for-bit repeatable; slower")
    )
    dry: bool = field(default=False, metadata=about("check and describe the run; train nothing"))
    compile_cache: Literal["auto"] | str | None = field(
        default="auto",
        metadata=about("directory for compiled programs; auto: the user's cache; null: none"),
    )
    memory_share: float = field(
        default=0.8,
        metadata=about("share of the GPU's memory that arenas=auto fills", above=0.0, high=1.0),
    )

    def _check(self) -> None:
        given = (self.processes, self.process)
        if self.coordinator in (None, "auto"):
            if given != (None, None):
                where = "null" if self.coordinator is None else "auto"
                raise ConfigError(
                    f"processes is {show(self.processes)} and process {show(self.process)}, but "
                    f"coordinator is {where}: give them only with coordinator=HOST:PORT."
                )
            return
        host, _, port = str(self.coordinator).rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port[:9]) < 2**16:
            raise ConfigError(
                f"coordinator is {show(self.coordinator)}: give HOST:PORT, auto or null."
            )
        if self.processes is None or self.process is None or self.process >= self.processes:
            raise ConfigError(
                f"coordinator is {show(self.coordinator)}, but processes is "
                f"{show(self.processes)} and process {show(self.process)}: give the number of "
                "processes, and the index of this one, counted from 0."
            )


@dataclass(frozen=True, kw_only=True)
class TrainConfig(ProgramConfig):
    """All settings of a training run: what the program does, and where the run is written."""

    command: ClassVar[str] = "train"
    renamed: ClassVar[Mapping[str, str]] = {"start": "init_from", "start_std": "init_from_std"}

    # `recipes.expand` replaces this word by the recipe's words, so no config holds it.
    recipe: str | None = field(
        default=None,
        metadata=about("settings of a whole run, which other arguments override", stored=False),
    )
    run: RunConfig = field(default_factory=RunConfig)
    resume: str | None = field(
        default=None,
        metadata=about("run directory to go on with; auto: run.dir, if it holds a run"),
    )
    init_from: str | None = field(
        default=None,
        metadata=about("run directory to take the first networks and normaliser from"),
    )
    init_from_std: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about("exploration after init_from; keep: as learned; reset: algo.initial_std"),
    )
    stage_name: str = field(
        default="",
        metadata=about("name of the stage or of the curriculum", derived=True),
    )

    def _check(self) -> None:
        object.__setattr__(self, "sim", make_room(self.sim, self.stage))
        if self.seed + self.seeds - 1 > MAX_COUNT:
            raise ConfigError(
                f"seed is {self.seed}, but seeds is {self.seeds} and the last seed may be at most "
                f"{MAX_COUNT}: give at most {MAX_COUNT - self.seeds + 1}."
            )
        self._check_stages()
        self._check_prerequisites()
        self._check_devices()
        self._check_budget()
        self._check_counts()
        self._check_algo()
        self._check_levels()
        self._check_episodes()
        check_realism(self.realism, self.robot, self.task, self.task.step_limit)
        if self.arena_devices > 1:
            object.__setattr__(self, "streams", self.stream_count)
        names = self.stage_names
        if len(names) == 1 or not self.stage_name:
            object.__setattr__(self, "stage_name", "-".join(names))

    def _check_stages(self) -> None:
        if not self.stage:
            raise ConfigError("stage is []: give at least one stage.")
        names = self.stage_names
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"stage names {name} more than once: give each stage once.")
        for stage in self.stage:
            where = "stage." if len(names) == 1 else f"stage {stage.name}: "
            for key, least in (("robots", 1), ("obstacles", 0)):
                value, most = getattr(stage, key), getattr(self.sim, f"max_{key}")
                if value > most:
                    raise ConfigError(
                        f"{where}{key} is {value}, but sim.max_{key} is {most}: "
                        f"give {least} to {most}."
                    )

    def _check_prerequisites(self) -> None:
        first, stages = self.curriculum.prerequisites or 0, len(self.stage)
        if first and first >= stages:
            raise ConfigError(
                f"curriculum.prerequisites is {first}, but the run has "
                f"{words.count(stages, 'stage')}: give at most {stages - 1}."
            )

    def _check_devices(self) -> None:
        share = self.arena_devices
        if self.streams is not None and self.streams % share:
            raise ConfigError(
                f"streams is {self.streams}, but devices is {share}: give a multiple of {share}, "
                "or null."
            )
        streams, minibatches = self.stream_count, self.algo.num_minibatches
        if self.arenas % (streams * minibatches):
            which = "streams" if self.streams else "devices"
            spread = "" if streams == 1 else f"{which} is {streams} and "
            raise ConfigError(
                f"arenas is {self.arenas}, but {spread}algo.num_minibatches is {minibatches}: "
                f"give a multiple of {streams * minibatches}."
            )
        if self.devices > 1 and self.seeds_by == "cores":
            raise ConfigError(
                f"seeds_by is cores, but devices is {self.devices}: give vmap, map or devices, or "
                "devices=1."
            )
        if self.seeds_by == "devices" and self.seeds % self.devices:
            raise ConfigError(
                f"seeds is {self.seeds}, but seeds_by is devices and devices is {self.devices}: "
                f"give a multiple of {self.devices}."
            )

    def _check_counts(self) -> None:
        steps = max(self.task.step_limit, self.algo.rollout_length)
        most = MAX_COUNT // (self.sim.robots * steps)
        if self.arenas > most:
            raise ConfigError(
                f"arenas is {self.arenas}, but robot steps are counted in 32 bits, which is enough "
                f"for {most} arenas with {self.sim.robots} robots and {steps} control steps: "
                f"give at most {most}."
            )

    def _check_episodes(self) -> None:
        if self.run.episodes and self.arenas * self.seeds > MOST_LOGGED:
            raise ConfigError(
                f"run.episodes is true, but arenas is {self.arenas} and seeds is {self.seeds}: "
                f"give at most {MOST_LOGGED} arenas of all seeds together, or run.episodes=false."
            )

    def _check_levels(self) -> None:
        levels = self.curriculum.levels
        if not levels.is_on:
            return
        if levels.buffer is not None and levels.buffer < len(self.stage):
            raise ConfigError(
                f"curriculum.levels.buffer is {levels.buffer}, but {len(self.stage)} stages share "
                f"it equally: give at least {len(self.stage)}."
            )
        if levels.mutates:
            for stage in self.stage:
                mutation.check(stage)

    def _check_algo(self) -> None:
        if self.task.history > 1 and self.algo.memory != "none":
            raise ConfigError(
                f"task.history is {self.task.history}, but algo.memory is {self.algo.memory}: "
                "choose one, task.history=1 or algo.memory=none."
            )
        self._check_hearing()
        self._check_team_reward()
        if self.algo.exploration == "scheduled" and self.budget > MAX_COUNT:
            raise ConfigError(
                f"budget is {self.budget}, but algo.exploration=scheduled counts control steps in "
                f"32 bits: give at most {MAX_COUNT}."
            )
        if self.curriculum.normalizer == "relearn" and not self.algo.normalize_observations:
            raise ConfigError(
                "curriculum.normalizer is relearn, but algo.normalize_observations is false: "
                "give keep or algo.normalize_observations=true."
            )

    def _check_hearing(self) -> None:
        """Refuses options that a network with neighbour messages does not support."""
        count = self.task.neighbours.count
        if count and self.algo.update_backend == "fused":
            raise ConfigError(
                f"algo.update_backend is fused, but task.neighbours.count is {count}: give auto or "
                "autodiff, or task.neighbours.count=0."
            )
        if count and self.algo.network not in (None, "mlp"):
            raise ConfigError(
                f"algo.network is {self.algo.network}, but task.neighbours.count is {count}, which "
                "works only with hidden layers: give algo.network=mlp or task.neighbours.count=0."
            )

    def _check_team_reward(self) -> None:
        """Refuses shared rewards if a robot's return ends at its arrival."""
        if not self.algo.team_reward:
            return
        if self.algo.advantage == "monte_carlo" and self.task.arrival == "latch":
            raise ConfigError(
                f"algo.team_reward is {show(self.algo.team_reward)}, but algo.advantage is "
                "monte_carlo and task.arrival is latch, so returns end at a robot's arrival: give "
                "algo.advantage=gae, task.arrival=hold or algo.team_reward=0."
            )

    def _check_budget(self) -> None:
        update = self.arenas * self.algo.rollout_length
        if self.updates < 1:
            raise ConfigError(
                f"budget is {self.budget}, but one update takes arenas x algo.rollout_length = "
                f"{update} control steps: give at least {update}."
            )
        most = MAX_COUNT // (self.algo.epochs * self.algo.num_minibatches)
        if self.updates > most:
            raise ConfigError(
                f"budget is {self.budget}, which is {self.updates} updates of {update} control "
                f"steps, but gradient steps are counted in 32 bits, which is enough for {most} "
                f"updates: give at most {most * update}."
            )


def from_stored(stored: Mapping[str, Any], where: str = "") -> TrainConfig:
    """Makes the configuration that a run directory or a policy holds, written by any version.

    Args:
      stored: the result of `to_dict`. Old names of keys are translated, and removed keys are left
        out.
      where: the prefix of its keys in messages.

    Raises:
      ConfigError: if it is invalid.
    """
    return build(TrainConfig, modernise(TrainConfig, stored), where)


def read_config(run: Path) -> dict:
    """Reads the config that a run directory was trained with.

    Args:
      run: the directory.

    Returns:
      The config as plain data, unchecked.

    Raises:
      ConfigError: if there is none, or it is not a JSON object.
    """
    path = run / CONFIG
    section.check_text("the run directory", str(run))
    if not path.exists():
        raise ConfigError(f"{run} is no run directory: it has no {CONFIG}.")
    found = reading.read_json(path)
    if not isinstance(found, dict):
        raise ConfigError(f"{path} is not a run's config: it holds no JSON object.")
    return found


def load_train(
    overrides: Sequence[str],
    *,
    auto: bool = False,
    stages: Sequence[dict[str, Any]] | None = None,
) -> TrainConfig:
    """Makes the configuration of `swarmjax.train` from its `key=value` words.

    Args:
      overrides: the words.
      auto: whether to accept `arenas=auto`. The config then has the smallest possible number of
        arenas, `algo.num_minibatches`. `memory.fill` chooses the final number later.
      stages: plain data of the stages, in place of a file.

    Raises:
      ConfigError: if a word, a choice, a file or a value is invalid.
    """

    def complete(mapping: dict[str, Any], chosen: dict[str, str]) -> dict[str, Any]:
        if auto and mapping.get("arenas") == AUTO:
            mapping["arenas"] = build(AlgoConfig, mapping.get("algo", {}), "algo.").num_minibatches
        if "init_from_std" in mapping and mapping.get("init_from") is None:
            raise ConfigError(
                f"init_from_std is {mapping['init_from_std']}, but there is no init_from: give "
                "init_from=DIR with it, the directory of a run."
            )
        if stages is not None:
            return mapping | {"stage": list(stages)}
        found = stage_files.expand(mapping.get("stage", {}), chosen["stage"])
        return mapping | {"stage": found, "stage_name": stage_files.name_of(chosen["stage"])}

    given = recipes.expand(TrainConfig, overrides)
    return settle(files.load(TrainConfig, [*_inherited(given), *given], complete))


# The algo keys that a run with init_from must share with the run that it starts from.
_SHARED = (
    "policy",
    "network",
    "hidden_sizes",
    "memory",
    "memory_size",
    "critic",
    "activation",
    "mean_activation",
)


def _inherited(typed: Sequence[str]) -> list[str]:
    """Returns the words that a run with `init_from` takes from the run that it starts from.

    They set robot, task, realism and the shape of the networks. Typed words override them.
    """
    source = files.values(files.split_words(TrainConfig, typed)).get("init_from")
    if not isinstance(source, str):
        return []
    try:
        held = from_stored(read_config(Path(source)))
    except ConfigError:  # `warm_start.read` reports it later, when the run begins
        return []
    others = [key for key in to_dict(held.algo) if key not in _SHARED]
    if held.algo.memory == "none" or any(
        word.startswith(("algo.memory=", "algo=")) for word in typed
    ):
        others.append("memory_size")  # this key belongs to the kind of memory that was typed
    return [
        *inherit.group_words(TrainConfig, "robot", held.robot, typed),
        *inherit.group_words(TrainConfig, "task", held.task, typed),
        *inherit.group_words(TrainConfig, "algo", held.algo, typed, skip=others),
        *inherit.preset_words(TrainConfig, "realism", held.realism, typed),
    ]


def settle(settings: TrainConfig) -> TrainConfig:
    """Adds the full names and digests of the extension pieces that a run uses.

    Args:
      settings: the config. Digests that the config already holds come from a stored run.

    Raises:
      ConfigError: if a piece is missing, or differs from the one that the stored run used.
    """
    found = extension.load(settings.extensions)
    extension.check_needs(settings.pieces, found, "the stored run")
    used = pieces.choose(found, settings.task, settings.stage)
    network = resolve(settings.algo, found.networks)
    if settings.extensions is None:
        return settings
    drawn = {stage.level for stage in settings.stage}
    chosen = found._replace(
        rewards=tuple(piece for piece, _ in used.terms),
        observations=used.observations,
        levels=tuple(each for each in found.levels if each.name in drawn),
        networks=tuple(each for each in found.networks if each.name == network),
    )
    return replace(
        settings,
        task=pieces.resolve(found, settings.task),
        algo=replace(settings.algo, network=network),
        pieces=chosen.digests(),
    )


def load_resume(stored: Mapping[str, Any], overrides: Sequence[str]) -> TrainConfig:
    """Makes the configuration with which a stored run goes on.

    `run.stop_after` is not kept: it interrupted the stored run, and would stop this one at once.

    Args:
      stored: configuration of the run, as `to_dict` gave it.
      overrides: `key=value` words, only for keys that may change.

    Raises:
      ConfigError: if another key is given, or a stored or new value is invalid.
    """
    words = files.split_words(TrainConfig, overrides)
    for key, word in words.items():
        if key not in _RESUME_KEYS and not key.startswith("run."):
            allowed = ", ".join(_RESUME_KEYS)
            raise ConfigError(
                f"{section.show(word, quote='')} cannot be given: resume keeps the rest of "
                f"the stored run and takes {allowed} only."
            )
    given = files.values(words)
    kept = to_dict(from_stored(stored, "stored "))
    run = kept["run"] | {"stop_after": None} | given.get("run", {})
    spread = _spread_again(kept["streams"], given.get("devices", kept["devices"]), kept["seeds_by"])
    return settle(build(TrainConfig, kept | spread | given | {"run": run}))


def _spread_again(streams: int | None, devices: Any, seeds_by: str) -> dict[str, Any]:
    """Spreads a resumed run over its devices, and keeps its random streams if they fit."""
    by_seeds = seeds_by == "devices"
    fits = isinstance(devices, int) and streams and (by_seeds or streams % devices == 0)
    return {"devices": devices, "streams": streams if fits else None}


def load_run(
    overrides: Sequence[str], stages: Sequence[dict[str, Any]] | None = None
) -> tuple[TrainConfig, bool]:
    """Makes the configuration of a new run or, with `resume=`, of a run that goes on.

    Args:
      overrides: `key=value` words; with `resume`, only for keys that may change.
      stages: plain data of the stages of a new run, in place of a file.

    Returns:
      The configuration, and whether the number of arenas is still to be chosen.

    Raises:
      ConfigError: if a word, a choice, a file or a value is invalid.
    """
    resumed = _by_key(overrides).get("resume", "null").strip("'\"")
    if resumed not in ("", "null", AUTO):
        return _go_on(Path(resumed), overrides), False
    overrides = recipes.expand(TrainConfig, overrides)
    given = _by_key(overrides)
    if resumed == AUTO:
        return _go_on_or_begin(overrides, given, stages)
    auto = given.get("arenas", "").strip("'\"") == AUTO
    return load_train(overrides, auto=auto, stages=stages), auto


def _go_on(run: Path, overrides: Sequence[str]) -> TrainConfig:
    """Makes the configuration with which the run in a directory goes on."""
    settings = load_resume(read_config(run), overrides)
    asked = _by_key(overrides).get("run.dir", "null") not in ("", "null")
    directory = settings.run.dir if asked else None
    return replace(settings, run=replace(settings.run, dir=directory or settings.resume))


def _by_key(words: Sequence[str]) -> dict[str, str]:
    """Returns the value of each key as typed; the last one counts."""
    return {key: value for key, _, value in (word.partition("=") for word in words)}


def _go_on_or_begin(
    overrides: Sequence[str], given: Mapping[str, str], stages: Sequence[dict[str, Any]] | None
) -> tuple[TrainConfig, bool]:
    """Makes the configuration for `resume=auto`: of the run in `run.dir`, or of a new run there."""
    if given.get("run.dir", "null") in ("", "null"):
        raise ConfigError("resume is auto, but there is no run.dir: give run.dir=DIR with it.")
    begun = [word for word in overrides if word.partition("=")[0] != "resume"]
    auto = given.get("arenas", "").strip("'\"") == AUTO
    typed = load_train(begun, auto=auto, stages=stages)
    run = Path(typed.run.dir or "")
    if not (run / CONFIG).exists():
        return typed, auto
    stored = from_stored(read_config(run), "stored ")
    if auto:
        typed = replace(typed, arenas=stored.arenas)
    _check_unchanged(run, to_dict(typed), to_dict(stored))
    kept = replace(typed.run, id=stored.run.id)
    spread = _spread_again(stored.streams, typed.devices, stored.seeds_by)
    if typed.streams is not None and "streams" in given:
        spread["streams"] = typed.streams
    settled = replace(stored, budget=typed.budget, resume=str(run), run=kept, **spread)
    return settle(settled), False


def _check_unchanged(run: Path, typed: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Refuses to resume a run with other settings than its own, and names the keys that differ."""
    mine, its = (
        leaves({k: v for k, v in each.items() if k not in MAY_CHANGE}) for each in (typed, stored)
    )
    changed = [key for key in mine if mine[key] != its.get(key)]
    if changed:
        shown = ", ".join(f"{k} is {show(mine[k])} and not {show(its.get(k))}" for k in changed[:3])
        raise ConfigError(
            f"resume is auto, but {run} holds a run with other settings: {shown}. A resumed run "
            f"may change only {', '.join(_RESUME_KEYS)}: give its own settings, or another run.dir."
        )


def leaves(found: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Flattens nested settings to dotted keys.

    Args:
      found: plain data, as `to_dict` gives it.
      where: the prefix of its keys.
    """
    flat: dict[str, Any] = {}
    for key, value in found.items():
        inner = isinstance(value, Mapping)
        flat |= leaves(value, f"{where}{key}.") if inner else {f"{where}{key}": value}
    return flat
