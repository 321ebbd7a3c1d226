"""The compiled program of a run: everything that is fixed before the run starts."""

from dataclasses import dataclass

import jax

from swarmjax import extension
from swarmjax.config.foreign_code import explained
from swarmjax.curriculum import engine as curricula
from swarmjax.curriculum import levels
from swarmjax.curriculum import stages as stage_modes
from swarmjax.curriculum.engine import Curriculum, Schedule
from swarmjax.ppo.networks import Hearing, Sizes
from swarmjax.ppo.ppo import PPO
from swarmjax.provenance import cores
from swarmjax.shards import Shards
from swarmjax.sim import drive
from swarmjax.task import env, extended, surroundings
from swarmjax.task.config import NEIGHBOUR_SIZE
from swarmjax.task.env import World
from swarmjax.training import episodes
from swarmjax.training.config import ProgramConfig

MAX_ROWS = 4096  # most updates of a call, over all seeds; longer chunks take several calls


@dataclass(frozen=True, eq=False)
class Program[C: ProgramConfig]:
    """The parts that fix the compiled program.

    Attributes:
      config: its settings.
      world: the compiled environment.
      ppo: how the learners act and learn.
      by_robot: whether to report each episode robot by robot.
    """

    config: C
    world: World
    ppo: PPO
    by_robot: bool = False

    @property
    def shards(self) -> Shards:
        """How the arenas are spread over devices."""
        return shards_of(self.config)

    @property
    def rows(self) -> int:
        """Most updates of one call."""
        most = max(1, MAX_ROWS // self.config.seeds)
        if self.by_robot:
            most = min(most, episodes.rows_of_call(self.config))
        return min(self.config.updates, most)

    def curriculum(self, schedule: Schedule) -> Curriculum:
        """Returns the curriculum with the numbers of a schedule."""
        options = self.config.curriculum
        own = {piece.name: piece for piece in extension.load(self.config.extensions).curricula}
        if options.mode in own:
            guard = explained(f"{extended.label(own[options.mode])} fails")
            by_stage = Curriculum(*map(guard, guard(own[options.mode].function)(schedule)))
        else:
            by_stage = stage_modes.make(schedule, options)
        if options.levels == "none":
            return by_stage
        return levels.make(by_stage, len(self.config.stage), options)


def shards_of(config: ProgramConfig) -> Shards:
    """Returns how the arenas of a seed are spread over devices."""
    return Shards(config.arena_devices, config.stream_count)


def build[C: ProgramConfig](config: C, world: World, *, by_robot: bool = False) -> Program[C]:
    """Builds the program of an environment that is there already; otherwise as `load`."""
    return Program(config, world, load_ppo(config, world), by_robot)


def load[C: ProgramConfig](config: C, *, by_robot: bool = False) -> tuple[Program[C], Schedule]:
    """Builds the program and the curriculum's numbers; resolves every setting left to `auto`.

    Args:
      config: the settings.
      by_robot: whether to report each episode robot by robot.

    Returns:
      The program, and the curriculum's numbers, which are an argument of the program.

    Raises:
      ConfigError: Warp is required but not installed, the gradient's backend is not available, or a
        part of an extension does not fit.
    """
    return build(config, load_world(config), by_robot=by_robot), schedule(config)


def load_ppo(config: ProgramConfig, world: World) -> PPO:
    """Builds PPO for the observations and actions of an environment.

    Raises:
      ConfigError: the network of an extension or the gradient's backend does not fit.
    """
    size, heard = world.observation_size, config.task.neighbours
    first = size - heard.size
    sizes = Sizes(
        observation=size,
        action=drive.ACTION_SIZE,
        state=surroundings.SIZE if config.algo.critic == "state" else 0,
        hearing=Hearing(first, heard.count, NEIGHBOUR_SIZE) if heard.count else None,
    )
    return PPO.make(
        config.algo,
        sizes,
        config.updates,
        pieces=extension.load(config.extensions).networks,
        shards=shards_of(config),
        side_by_side=side_by_side(config) * config.learners,
    )


def load_world(config: ProgramConfig) -> World:
    """Builds the environment, with memory for all arenas that are stepped together."""
    return env.load(
        config.stage,
        config.robot,
        config.task,
        config.realism,
        config.sim,
        arenas=config.arenas // config.arena_devices * side_by_side(config),
        extensions=extension.load(config.extensions),
    )


def schedule(config: ProgramConfig) -> Schedule:
    """Computes the curriculum's numbers."""
    return curricula.schedule(
        config.stage,
        config.curriculum,
        updates=config.updates,
        step_limit=config.task.step_limit,
        rollout=config.algo.rollout_length,
        drawings=extension.load(config.extensions).levels,
    )


def groups(config: ProgramConfig, cores: int) -> int:
    """Returns into how many equal groups the seeds are split; the groups run at the same time.

    Args:
      config: settings of the run.
      cores: number of cores that the process may use.
    """
    if config.seeds_by != "cores" or jax.default_backend() != "cpu":
        return 1
    return next(n for n in range(min(cores, config.seeds), 0, -1) if config.seeds % n == 0)


def side_by_side(config: ProgramConfig) -> int:
    """Returns how many seeds one call of the program steps at once on a device."""
    parts = config.devices if config.seeds_by == "devices" else groups(config, cores())
    return config.seeds // parts
