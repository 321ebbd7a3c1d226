"""Evaluates policies on the training device and in the training engine, many arenas at once.

Levels, rules and metrics are those of `engine_c.py`. Sensors and solver are those of training.
Published results come from MuJoCo C; this engine is faster.
"""

import functools
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax import extension, policy, policy_network
from swarmjax.config import ConfigError
from swarmjax.evaluate import judge, measures
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.measures import Outcome
from swarmjax.policy import Policy
from swarmjax.sim import noise, physics
from swarmjax.sim.config import SimConfig
from swarmjax.sim.noise import Stream
from swarmjax.task import env
from swarmjax.task import stage as task_stage
from swarmjax.task import world as task_world
from swarmjax.task.env import EnvState
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.world import World
from swarmjax.training import rollout

_ABOUT = ("policy", "activation", "observation", "action")  # keys of `meta` that shape a program
_WEIGHTS = ("layers", "log_std", "mean", "std", "memory")


def load(config: EvaluateConfig, half: np.ndarray, arenas: int) -> World:
    """Compiles the environment for levels of one kind, with the judge's physics step.

    Args:
      config: settings of the evaluation.
      half: [M, 2] half edges of the boxes in the levels, m.
      arenas: number of levels that are simulated together.

    Returns:
      The world; `_program` sets the policy's speed limits and encoding.

    Raises:
      ConfigError: a box is larger than a stage allows.
    """
    fits = half.max(initial=0.0) <= task_stage.largest_half([config.stage])
    stage = config.stage if fits else _largest(config.stage, half)
    sim = SimConfig(
        max_robots=stage.robots, max_obstacles=len(half), substeps=judge.substeps(config)
    )
    return task_world.load(
        (stage,),
        config.robot,
        config.task,
        config.realism,
        sim,
        arenas=arenas,
        extensions=extension.load(config.extensions),
    )


def _largest(stage: StageConfig, half: np.ndarray) -> StageConfig:
    """Returns a stage with the same robot count and box size; the program needs only these."""
    largest = 2.0 * float(half.max(initial=0.05))  # without boxes any size will do
    return StageConfig(name=stage.name, robots=stage.robots, side=4.0, obstacle_size=largest)


def play(
    world: World, levels: Level, trained: Policy, steps: int, *, sampled: bool = True
) -> Outcome:
    """Runs an episode of each level with a policy.

    Args:
      world: result of `load`.
      levels: [E] with all robots and obstacles of the world.
      trained: the policy.
      steps: control steps of an episode.
      sampled: whether to sample the actions from the policy; otherwise they are its means.

    Returns:
      [E] outcomes, as NumPy arrays.

    Raises:
      ConfigError: the physics of an episode breaks down.
    """
    network = trained.network
    about = json.dumps({key: trained.meta[key] for key in _ABOUT})
    run = _program(world, steps, about, sampled, network and network.module)
    weights = {name: getattr(trained, name) for name in _WEIGHTS}
    memory = policy.begin(trained, levels.present.shape)
    outcome, broken = run(weights, network and network.params, levels, memory)
    if np.any(broken):
        raise ConfigError(
            f"the physics of {int(np.sum(broken))} of {len(levels.side)} episodes broke down: some "
            f"positions are not finite; give substeps of more than {world.physics.substeps}."
        )
    return Outcome(*map(np.asarray, outcome))


@functools.lru_cache(maxsize=4)
def _program(
    world: World, steps: int, about: str, sampled: bool, module: Any
) -> Callable[..., tuple[Outcome, Array]]:
    """Compiles the program for policies that differ only in their weights.

    Args:
      world: result of `load`.
      steps: control steps of an episode.
      about: JSON of what a policy's description says under the keys `_ABOUT`.
      sampled: whether to sample the actions.
      module: Flax module of an extension's network; None if there is none.
    """
    meta = json.loads(about)
    layout, (speed, turn_rate) = meta["observation"], meta["action"]["high"][:2]
    weights: dict[str, Any] = dict.fromkeys(_WEIGHTS)  # given when the program runs
    bare = Policy(
        **weights,
        is_shared=meta["policy"] == "shared",
        encoding=layout["encoding"],
        max_speed=speed,
        max_turn_rate=turn_rate,
        meta=meta,
        digest="",
    )
    mine = replace(
        world,
        drive=world.drive._replace(max_speed=speed, max_turn_rate=turn_rate),
        electronics=replace(world.electronics, encoding=layout["encoding"]),
    )

    @jax.jit
    def play(
        weights: Any, params: Any, levels: Level, memory: Array | None
    ) -> tuple[Outcome, Array]:
        network = module and partial(policy_network.features, module, params)
        trained = bare._replace(**weights, network=network)

        def act(memory: Any, arenas: EnvState) -> tuple[Any, Array]:
            """Samples the actions [E, R, U] with the judge's random numbers, or takes the means."""
            shape = (arenas.observation.shape[-2], len(meta["action"]["names"]))
            seed, clock = arenas.level.seed, arenas.clock
            normal = noise.normal(seed, clock, Stream.ACTION, shape, jnp) if sampled else 0.0
            with jax.default_matmul_precision("highest"):  # as NumPy computes
                return policy.step(trained, memory, arenas.observation, normal, jnp)

        return run(mine, act, levels, steps, memory)[1:]

    return play


# Takes a memory [E, R, H] or None, and arenas; returns the new memory, and actions.
Actor = Callable[[Any, EnvState], tuple[Any, Array]]


def run(
    world: World, act: Actor, levels: Level, steps: int, memory: Array | None
) -> tuple[EnvState, Outcome, Array]:
    """Runs an episode of each level.

    Args:
      world: the compiled environment.
      act: chooses the actions.
      levels: [E] levels.
      steps: control steps of an episode, at least 1.
      memory: memory at the start.

    Returns:
      The final arenas, the outcomes, and whether the physics of each arena broke down. Such an
      episode ends, and its robots stay where they were before the step.
    """
    robots, obstacles = world.spacing.robots, world.spacing.obstacles
    chex.assert_shape(levels.present, (None, robots))
    chex.assert_shape(levels.obstacle, (len(levels.side), obstacles, 5))
    levels = jax.tree.map(jnp.asarray, levels)
    arenas = jax.vmap(lambda each: env.reset(world, each))(levels)
    unpack = partial(physics.unpack, world.physics)
    arenas = replace(arenas, sim=jax.vmap(unpack)(arenas.sim))
    outcome = measures.begin(levels.start[..., :2], jnp, len(world.goal.measures))
    unbroken = jnp.zeros(len(levels.side), bool)
    step = partial(_step, world, act)
    carry = (arenas, outcome, unbroken, memory)
    (arenas, outcome, broken, _), _ = jax.lax.scan(step, carry, length=steps)
    return arenas, outcome, broken


_Carry = tuple[EnvState, Outcome, Array, Array | None]


def _step(
    world: World,
    act: Actor,
    carry: _Carry,
    _: None,
) -> tuple[_Carry, None]:
    """Advances the arenas [E] by a control step, except those whose episodes are over."""
    arenas, outcome, broken, memory = carry
    memory, action = act(memory, arenas)
    moved, came = jax.vmap(partial(env.step, world))(arenas, action)
    over = broken | world.goal.is_over(arenas.arrived, arenas.level.present)
    broken = broken | (~over & ~came.sound)
    stays = over | broken
    held = replace(arenas, sim=jax.vmap(physics.pack)(arenas.sim))
    counted = measures.tally(outcome, _events(world, arenas, moved, came), jnp)
    outcome = jax.tree.map(
        lambda old, new: jnp.where(stays.reshape(-1, *[1] * (new.ndim - 1)), old, new),
        outcome,
        counted,
    )
    return (rollout.restart(moved, held, stays), outcome, broken, memory), None


def _events(world: World, before: EnvState, after: EnvState, came: env.TimeStep) -> measures.Events:
    """Returns the events of a control step, partly from the counters of `env.step`."""
    poses = jax.vmap(partial(physics.poses, world.physics))
    return measures.Events(
        start=poses(before.sim)[..., :2],
        place=poses(after.sim)[..., :2],
        arrived=after.arrived,
        begins=after.episode.contacts - before.episode.contacts,
        touches=after.apart == 0.0,
        sensed=after.episode.sensed > before.episode.sensed,
        under_way=world.goal.is_under_way(before.arrived),
        rests=~world.goal.is_under_way(after.arrived),
        measured=came.measured,
    )
