"""The settings that determine the compiled program of a run."""

from dataclasses import dataclass, field
from typing import Literal

from swarmjax.config import Section, about, setting
from swarmjax.config.section import MAX_COUNT, ByName
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.ppo.config import AlgoConfig
from swarmjax.sim.config import RobotConfig, SimConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.stage_config import StageConfig

# By default, one level is drawn for each arena and every STEPS_PER_EPISODE control steps of a
# rollout. The shortest episodes of the six stages take 23 steps.
STEPS_PER_EPISODE = 32


@dataclass(frozen=True, kw_only=True)
class ProgramConfig(Section):
    """The settings that determine the compiled program. A subclass adds a command's settings."""

    stage: tuple[StageConfig, ...]
    robot: RobotConfig = field(default_factory=RobotConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    algo: AlgoConfig = field(default_factory=AlgoConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    sim: SimConfig = field(default_factory=SimConfig)
    seed: int = setting(0, "random seed", 0, MAX_COUNT)
    seeds: int = setting(
        1,
        "number of runs trained at once, with seeds seed, seed + 1, ...",
        1,
        4096,
        reason="a call of the compiled program reports one row per seed, at most 4096. Train more "
        "in a second run, with seed=4096",
    )
    seeds_by: Literal["vmap", "cores", "devices"] = setting(
        "vmap",
        "how to train the seeds; vmap: all side by side; cores: split over the cores of a CPU; "
        "devices: split over the devices",
    )
    arenas: int = setting(128, "arenas simulated at once", 1, 2**20)
    devices: int = setting(
        1,
        "number of devices that share the arenas of every seed, or, with seeds_by=devices, that "
        "share the seeds",
        1,
        2**16,
    )
    streams: int | None = setting(
        None,
        "number of random streams, a multiple of devices; runs with equal streams draw the same "
        "random numbers on any number of devices; null: one for each device that shares the arenas",
        1,
        2**16,
    )
    budget: int = setting(3_000_000, "control steps to train, summed over all arenas", 1, 10**15)
    levels_per_rollout: int | None = setting(
        None,
        "levels drawn for each arena before a rollout; an arena that needs more repeats the last "
        "level, and success does not count these repeats; null: one for every 32 control steps",
        1,
        1024,
    )
    realism: RealismConfig = field(default_factory=RealismConfig)
    extensions: str | None = setting(
        None, "Python file with your own extension; it is executed", stored=False
    )
    pieces: dict[str, dict[str, str]] = field(
        default_factory=ByName,
        metadata=about("digest of each extension piece in use, by kind and name", derived=True),
    )

    @property
    def arena_devices(self) -> int:
        """Number of devices that share the arenas of a seed."""
        return 1 if self.seeds_by == "devices" else self.devices

    @property
    def stream_count(self) -> int:
        """Number of random streams of a seed."""
        return self.streams or self.arena_devices

    @property
    def updates(self) -> int:
        """Number of whole updates in the budget; the rest of the budget is not spent."""
        return self.budget // (self.arenas * self.algo.rollout_length)

    @property
    def learners(self) -> int:
        """Number of trained actor-critics: one, or one for each robot."""
        return self.sim.robots if self.algo.policy == "independent" else 1

    @property
    def stage_names(self) -> list[str]:
        """Names of the stages, in their order."""
        return [stage.name for stage in self.stage]

    @property
    def numbers(self) -> range:
        """The seeds of a run, in the order of the seed axis."""
        return range(self.seed, self.seed + self.seeds)

    @property
    def waiting(self) -> int:
        """Number of levels that are drawn for each arena before a rollout."""
        return self.levels_per_rollout or max(1, self.algo.rollout_length // STEPS_PER_EPISODE)
