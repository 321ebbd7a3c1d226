"""Evaluates learners on the training device, on the levels of `swarmjax.evaluate`."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from swarmjax.config import ConfigError
from swarmjax.evaluate import engine_mjx, judge
from swarmjax.ppo.ppo import PPO, LearnerState
from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.task import level, placement
from swarmjax.task import stage as task_stage
from swarmjax.task.env import EnvState
from swarmjax.task.level import Level, Spacing
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.world import World
from swarmjax.training import rollout


class Outcomes(NamedTuple):
    """The outcomes of episodes, [E] each; the first four have the names of `measures.per_level`.

    Attributes:
      targets_reached: share of targets reached, 0..1.
      all_reached: 1 if every robot arrived, else 0.
      contacts_per_robot: contacts of all kinds per robot.
      episode_time_s: time until all robots arrived or the time was out, s.
      broken: 1 if the episode ended because the physics stopped being finite, else 0.
    """

    targets_reached: Array
    all_reached: Array
    contacts_per_robot: Array
    episode_time_s: Array
    broken: Array


def draw_levels(world: World, stage: StageConfig, seed: int, episodes: int) -> Level:
    """Draws the levels of `swarmjax.evaluate`, padded to the world's robots and obstacles.

    Args:
      world: the compiled environment. The world's config has this stage, or a stage with obstacles
        of the same size.
      stage: stage of the levels.
      seed: seed of the evaluation.
      episodes: E.

    Returns:
      [E] levels, as NumPy arrays. Robots and obstacles that the stage lacks are parked outside.

    Raises:
      ConfigError: the stage has more robots or obstacles than the world is compiled for.
    """
    for key in ("robots", "obstacles"):
        value, most = getattr(stage, key), getattr(world.spacing, key)
        if value > most:
            raise ConfigError(
                f"stage {stage.name}: {key} is {value}, but sim.max_{key} is {most}: give "
                f"sim.max_{key}={value} or more."
            )
    one = task_stage.single(stage, world.drawings)
    spacing = world.spacing._replace(robots=stage.robots, obstacles=stage.obstacles)
    drawn = [
        _make_room(judge.draw_level(one, spacing, seed, episode, world.drawings), world.spacing)
        for episode in range(episodes)
    ]
    return Level(*(np.stack(fields) for fields in zip(*drawn, strict=True)))


def _make_room(drawn: Level, spacing: Spacing) -> Level:
    """Adds absent robots and obstacles to a level, and parks them."""
    robots = spacing.robots - len(drawn.present)
    obstacles = spacing.obstacles - len(drawn.obstacle_present)

    def widened(x: np.ndarray, more: int, fill: ArrayLike = 0) -> np.ndarray:
        return np.concatenate([x, np.full((more, *x.shape[1:]), fill, x.dtype)])

    wider = drawn._replace(
        present=widened(drawn.present, robots),
        start=widened(drawn.start, robots),
        target=widened(drawn.target, robots),
        obstacle_present=widened(drawn.obstacle_present, obstacles),
        # Parked obstacles need edges too, although no robot meets these obstacles.
        obstacle=widened(drawn.obstacle, obstacles, (0, 0, 0, placement.MARGIN, placement.MARGIN)),
    )
    return level.park(wider, np)


def outcomes(
    world: World,
    ppo: PPO,
    learners: LearnerState,
    levels: Level,
    steps: int,
    *,
    sampled: bool = False,
) -> Outcomes:
    """Runs an episode of each level with policies that are still in training.

    The function is pure: `jit` it with `world`, `ppo` and `steps` bound, and `vmap` it over the
    seeds of `learners`. With `impl=warp`, load the world for the number of arenas that are
    evaluated together (E, or E times the number of seeds), because MJX-Warp sizes its memory of
    contacts for that number. The world's `task.step_limit` is ignored.

    Args:
      world: the compiled environment.
      ppo: what made the learners.
      learners: [L].
      levels: [E].
      steps: control steps of an episode, at least 1.
      sampled: whether to draw the actions from the policies; otherwise each action is the policy's
        mean.

    Returns:
      [E] outcomes. If the physics of an episode breaks, the episode ends at that step, and its
      robots stay where they were before the step.
    """
    act = partial(_choose, ppo, learners, sampled=sampled)
    first = ppo.begin_memory(levels.present.shape).actor
    arenas, _, broken = engine_mjx.run(world, act, levels, steps, first)
    return _sum_up(arenas, broken, world.task.control_step)


def _choose(
    ppo: PPO, learners: LearnerState, memory: Any, arenas: EnvState, *, sampled: bool
) -> tuple[Any, Array]:
    """Returns the learners' actions [E, R, U], drawn as in the judge, or their means."""
    count = len(jax.tree.leaves(learners)[0])
    seen = rollout.to_learners(arenas.observation, count)
    mine = jax.tree.map(lambda x: rollout.to_learners(x, count), memory)
    shape = (arenas.observation.shape[-2], ppo.sizes.action)
    drawn = jnp.zeros((len(arenas.clock), *shape))
    if sampled:
        drawn = noise.normal(arenas.level.seed, arenas.clock, Stream.ACTION, shape, jnp)
    spread = rollout.to_learners(drawn, count)
    action, _, after = jax.vmap(ppo.act)(learners, seen, spread, mine)
    return jax.tree.map(rollout.to_arenas, after), rollout.to_arenas(action)


def _sum_up(arenas: EnvState, broken: Array, control_step: float) -> Outcomes:
    """Summarises episodes as `measures.per_level` does."""
    present = arenas.level.present
    robots = jnp.sum(present, axis=-1)
    reached = jnp.sum(present & arenas.arrived, axis=-1)
    contacts = jnp.sum(arenas.episode.contacts, axis=(-2, -1))
    return Outcomes(
        targets_reached=reached / robots,
        all_reached=(reached == robots).astype(jnp.float32),
        contacts_per_robot=contacts / robots,
        episode_time_s=arenas.clock * jnp.float32(control_step),
        broken=broken.astype(jnp.float32),
    )
