"""Builds the compiled program of a run from its settings."""

import math
from functools import partial

import jax
import numpy as np

from swarmjax import extension
from swarmjax.curriculum import axes, stages
from swarmjax.curriculum.config import PROMOTING
from swarmjax.curriculum.engine import NEVER, Schedule
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO
from swarmjax.provenance import cores
from swarmjax.shards import Shards
from swarmjax.sim import drive
from swarmjax.task import stage as task_stage
from swarmjax.task import surroundings
from swarmjax.task import world as task_world
from swarmjax.task.world import World
from swarmjax.training import episodes
from swarmjax.training.config import ProgramConfig
from swarmjax.training.rollout import Program

# With this option, XLA runs two iterations of a loop as one, so it need not copy what one iteration
# passes to the next. A step of 8,192 arenas thus took 542 us instead of 606 us on an H100
# (docs/performance.md).
_GPU_OPTIONS = {"xla_gpu_enable_while_loop_unrolling": "WHILE_LOOP_UNROLLING_DOUBLE_BUFFER"}
# With this option, XLA does not choose kernels by timing them, and uses no kernel that adds in a
# varying order.
_DETERMINISTIC = {"xla_gpu_deterministic_ops": True}
MAX_ROWS = 4096  # most updates of a call, summed over seeds; longer chunks take several calls


def build[C: ProgramConfig](config: C, world: World, *, by_robot: bool = False) -> Program[C]:
    """Builds the program as `load` does, but for an environment that exists already."""
    rows = max(1, MAX_ROWS // config.seeds)
    if by_robot:
        rows = min(rows, episodes.rows_of_call(config))
    own = extension.load(config.extensions).curricula
    return Program(
        config,
        world,
        load_ppo(config, world),
        partial(stages.make, options=config.curriculum, own=own),
        shards(config),
        by_robot=by_robot,
        waiting=config.waiting,
        rows=min(config.updates, rows),
    )


def load[C: ProgramConfig](config: C, *, by_robot: bool = False) -> tuple[Program[C], Schedule]:
    """Builds the program and the curriculum's schedule; resolves every setting that is `auto`.

    Args:
      config: the settings.
      by_robot: whether to report each episode robot by robot.

    Returns:
      The program, and the curriculum's schedule, which is an argument of the program.

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
    sizes = Sizes(
        observation=world.observation_size,
        action=drive.ACTION_SIZE,
        state=surroundings.SIZE if config.algo.critic == "state" else 0,
    )
    return PPO.make(
        config.algo,
        sizes,
        config.updates,
        pieces=extension.load(config.extensions).networks,
        shards=shards(config),
        side_by_side=side_by_side(config) * config.learners,
    )


def shards(config: ProgramConfig) -> Shards:
    """Returns how the arenas are spread over devices and random streams."""
    return Shards(config.arena_devices, config.stream_count)


def load_world(config: ProgramConfig) -> World:
    """Builds the environment, with memory for all arenas that are stepped together."""
    return task_world.load(
        config.stage,
        config.robot,
        config.task,
        config.realism,
        config.sim,
        arenas=config.arenas // config.arena_devices * side_by_side(config),
        extensions=extension.load(config.extensions),
    )


def schedule(config: ProgramConfig) -> Schedule:
    """Computes the curriculum's stages, deadlines and thresholds.

    All stages before the last together get the share `budget_share` of the updates, in equal parts.
    """
    options, before = config.curriculum, len(config.stage) - 1
    share = options.budget_share * config.updates / max(before, 1)
    deadline = [math.ceil(share * (i + 1)) for i in range(before)]
    if options.mode not in PROMOTING:
        deadline = [NEVER] * before
    return Schedule(
        stages=task_stage.stack(config.stage, extension.load(config.extensions).levels),
        deadline=np.array([*deadline, NEVER], np.int32),
        threshold=np.full(len(config.stage), options.threshold, np.float32),
        floor=np.float32(options.floor),
        cohort_updates=np.int32(math.ceil(config.task.step_limit / config.algo.rollout_length)),
        easier=axes.easier(options.axes, len(config.stage)),
    )


def groups(config: ProgramConfig, cores: int) -> int:
    """Returns the number of equal groups of seeds; all groups run at the same time.

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


def compiler_options(*, deterministic: bool = False) -> dict[str, str | bool]:
    """Returns XLA's options for the training loop on JAX's current device.

    Args:
      deterministic: Whether a GPU must compute the same bits each time. A CPU always does so.

    Returns:
      Values of XLA's options, by name.
    """
    if jax.default_backend() != "gpu":
        return {}
    return _GPU_OPTIONS | (_DETERMINISTIC if deterministic else {})
