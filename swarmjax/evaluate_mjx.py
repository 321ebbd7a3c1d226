"""Judges policies where they are trained: many arenas at once, on the device.

The levels are those of `swarmjax.evaluate`, drawn by the same function from the same seed, and so
are the rules and the figures. The engine is not: this is the one that trained, with its analytic
sensors and its few solver steps, and MuJoCo C stays the judge that results are published by. It
costs little, which is what a study needs that asks again and again while its policies learn.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from swarmjax import evaluate_c, rollout
from swarmjax.config import ConfigError, StageConfig
from swarmjax.ppo import learner as ppo
from swarmjax.ppo.learner import LearnerState
from swarmjax.sim import physics
from swarmjax.task import env, level
from swarmjax.task import stage as task_stage
from swarmjax.task.env import EnvState, World
from swarmjax.task.level import Level, Spacing


class Outcomes(NamedTuple):
    """What episodes came to, [E] each; the first four as `evaluate.per_level` names them.

    Attributes:
      targets_reached: share of targets reached, 0..1.
      all_reached: 1 where every robot arrived, else 0.
      contacts_per_robot: contacts of all kinds, a robot.
      episode_time_s: until all robots arrived or the time was out, s.
      broken: 1 where the physics ceased to be finite, which ended the episode there, else 0.
    """

    targets_reached: Array
    all_reached: Array
    contacts_per_robot: Array
    episode_time_s: Array
    broken: Array


def draw_levels(world: World, stage: StageConfig, seed: int, episodes: int) -> Level:
    """Draws the levels that `swarmjax.evaluate` starts from, with room for the world's robots.

    Args:
      world: the compiled environment, of a config with this stage or one of obstacles as large.
      stage: of the levels.
      seed: of the evaluation.
      episodes: E.

    Returns:
      [E] levels, as NumPy arrays; robots and obstacles that the stage lacks are parked outside.

    Raises:
      ConfigError: if the stage has more robots or obstacles than the world is compiled for.
    """
    for key in ("robots", "obstacles"):
        value, most = getattr(stage, key), getattr(world.spacing, key)
        if value > most:
            raise ConfigError(
                f"stage {stage.name}: {key} is {value}, but sim.max_{key} is {most}: give "
                f"sim.max_{key}={value} or more."
            )
    one = task_stage.select(task_stage.stack([stage]), np.intp(0))
    spacing = world.spacing._replace(robots=stage.robots, obstacles=stage.obstacles)
    drawn = [
        _make_room(evaluate_c.draw_level(one, spacing, seed, episode), world.spacing)
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
        # Whatever is parked has edges too; these nobody meets.
        obstacle=widened(drawn.obstacle, obstacles, (0, 0, 0, level.MARGIN, level.MARGIN)),
    )
    return level.park(wider, np)


def outcomes(world: World, learners: LearnerState, levels: Level, steps: int) -> Outcomes:
    """Runs an episode of each level, every robot driven by the mean of its policy.

    Pure: `jit` it with `world` and `steps` bound, and `vmap` it over the seeds of `learners`. With
    `impl=warp` the world must be loaded for as many arenas as are judged together (E, or E for
    every seed), since that is what the memory of contacts is sized for. Its `task.step_limit` is
    not read.

    Args:
      world: the compiled environment.
      learners: [L].
      levels: [E].
      steps: control steps of an episode, at least 1.

    Returns:
      [E] what they came to. An episode whose physics breaks ends there, its robots where they
      were.
    """
    robots, obstacles = world.spacing.robots, world.spacing.obstacles
    chex.assert_shape(levels.present, (None, robots))
    chex.assert_shape(levels.obstacle, (len(levels.side), obstacles, 5))
    zero = jnp.zeros((), jnp.int32)
    arenas = jax.vmap(lambda each: env.reset(world, each, zero, zero))(levels)
    unpack = partial(physics.unpack, world.physics)
    arenas = replace(arenas, sim=jax.vmap(unpack)(arenas.sim))
    unbroken = jnp.zeros(len(levels.side), bool)
    step = partial(_step, world, learners)
    (arenas, broken), _ = jax.lax.scan(step, (arenas, unbroken), length=steps)
    return _sum_up(arenas, broken, world.config.task.control_step)


def _step(
    world: World, learners: LearnerState, carry: tuple[EnvState, Array], _: None
) -> tuple[tuple[EnvState, Array], None]:
    """Moves the arenas [E] on by a control step whose episodes are not over."""
    arenas, broken = carry
    seen = rollout.to_learners(arenas.observation, len(jax.tree.leaves(learners)[0]))
    action = jax.vmap(partial(ppo.mode, config=world.config.algo))(learners, observation=seen)
    moved, came = jax.vmap(partial(env.step, world))(arenas, rollout.to_arenas(action))
    over = broken | _all_arrived(arenas)
    broken = broken | (~over & ~came.sound)
    held = replace(arenas, sim=jax.vmap(physics.pack)(arenas.sim))
    return (rollout.restart(moved, held, over | broken), broken), None


def _all_arrived(arenas: EnvState) -> Array:
    """Returns [E] whether every robot of the arena has arrived."""
    return jnp.all(arenas.arrived | ~arenas.level.present, axis=-1)


def _sum_up(arenas: EnvState, broken: Array, control_step: float) -> Outcomes:
    """Sums episodes up as `evaluate.per_level` does."""
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
