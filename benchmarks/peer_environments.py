"""How fast are other projects' environments?

`python -m benchmarks.peers who=vmas|camar|jaxnav [arenas=4096,65536] [key=value ...]` prints a JSON
line for each number of arenas. It times calls of `steps` control steps with random actions.

- `vmas` is VMAS's navigation scenario, the PyTorch environment most similar to ours. VMAS leaves
  resets to the caller, so the timed calls have no resets. This favours VMAS. The line also has the
  time for resetting all arenas. It needs the packages in `torch-peers.txt`.
- `camar` is the most similar to ours among the JAX environments for path finding in continuous
  space, with differential drives. CAMAR's own wrapper resets arenas optimistically: each step draws
  one new map per `reset_ratio` arenas, and the arenas whose episodes end in this step share these
  maps.
- `jaxnav` is JaxMARL's environment of differential drives with range sensors. `step=pool` calls
  JaxNav's `step_env`, and restarts arenas from a pool of states that were drawn beforehand. This
  favours JaxNav. `step=default` calls JaxNav's own `step`, which draws a whole map for every
  arena and step, and discards nearly all of these maps.
"""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from benchmarks import lines, peers, timing
from benchmarks.lines import Line
from benchmarks.peers import PeerConfig
from swarmjax import epuck
from swarmjax.config import about

SUBSTEPS = 2  # of VMAS's navigation scenario
FRAMESKIP = 2  # CAMAR's default; a control step has three substeps
CONTROL_STEP = 0.032  # s
DT = CONTROL_STEP / (FRAMESKIP + 1)  # s
CAMAR_CELLS = 6  # cells per side; they are 0.2 m wide, so the arena is 1.2 m wide
# JaxNav's cells are 1 m wide and its robots have a radius of 0.3 m, so our lengths are scaled by
# 0.3 / 0.037. Rays start at the robot's centre, and their last sample always counts as a hit. Thus
# 13 samples up to 0.68 m, about 0.05 m apart as by JaxNav's default, see 0.04 m beyond the hull.
RADIUS = 0.3
BEAMS, RANGE, RESOLUTION = 8, 0.68, 0.05
JAXNAV_CELLS = 12  # cells per side; the outer cells are walls, so the arena is 1.23 m wide
JAXNAV_FILL = 0.07  # 0 to 6 of 100 cells are obstacles, 3 on average
RESETS = {
    "pool": "one of a pool of states that were drawn beforehand, at random",
    "default": "a new map for every arena and step, used where an episode ends: its default",
}
# What a step of each peer includes.
COUNTED = {
    "vmas": {
        "step": "control step: two substeps of penalty contacts between discs in the plane, "
        "holonomic robots, 8 rays that see robots alone, no obstacles, reward",
        "resets": "none in the timed calls: VMAS leaves them to the caller",
        "precision": "float32, PyTorch without compilation",
    },
    "camar": {
        "step": "control step: three substeps of penalty contacts between discs in the plane, the "
        "vectors to the nearest objects instead of rays, reward",
        "resets": "optimistic: one fresh map for every reset_ratio arenas and step",
        "precision": "float32",
    },
    "jaxnav": {
        "step": "control step: kinematics in the plane, collisions end a robot's way, 8 rays "
        "marched over a grid map, reward",
        "precision": "float32",
    },
}


@dataclass(frozen=True, kw_only=True)
class VmasConfig(PeerConfig):
    """Settings for measuring VMAS."""

    device: Literal["auto", "cuda", "cpu"] = field(
        default="auto", metadata=about("device of PyTorch; auto: cuda if there is one")
    )


def vmas_task(config: PeerConfig) -> dict[str, Any]:
    """Returns the settings of VMAS's navigation, with lengths in m, for an arena 1.2 m wide."""
    return {
        "scenario": "navigation",
        "n_agents": config.robots,
        "continuous_actions": True,
        "collisions": True,
        "enforce_bounds": True,
        "world_spawning_x": 0.6,
        "world_spawning_y": 0.6,
        "n_lidar_rays": 8,
        "lidar_range": epuck.SENSOR_RANGE + epuck.HULL_RADIUS,  # from the centre
        "agent_radius": epuck.HULL_RADIUS,
        "shared_rew": False,
        "max_steps": config.step_limit,
    }


def vmas(words: Sequence[str]) -> Iterator[Line]:
    """Measures VMAS; yields a JSON line for each number of arenas."""
    config = lines.load(VmasConfig, words)
    torch, library = peers.find("torch", peers.TORCH), peers.find("vmas", peers.TORCH)
    device, task = peers.torch_device(torch, config.device), vmas_task(config)
    for arenas in config.arenas:
        world = library.make_env(num_envs=arenas, device=device, seed=config.seed, **task)
        with torch.no_grad():
            steps = partial(_vmas_steps, torch, world, config.steps)
            calls_s = timing.time_calls(steps, config.repeats)
            reset_s = timing.time_calls(partial(_vmas_reset, torch, world), config.repeats)
        yield {
            "benchmark": "peer_vmas.environment",
            "peer": "VMAS navigation",
            **peers.speed(config, arenas, SUBSTEPS, calls_s),
            "reset_s": reset_s,
            "compile_s": None,
            **COUNTED["vmas"],
            "settings": task,
            **peers.with_torch(torch, device, "vmas"),
        }


def _vmas_steps(torch: Any, world: Any, steps: int) -> None:
    """Steps all arenas with random actions, and waits for the device."""
    actions = torch.rand(steps, world.n_agents, world.num_envs, 2, device=world.device) * 2 - 1
    for step in actions:
        world.step(list(step))
    _wait(torch)


def _vmas_reset(torch: Any, world: Any) -> None:
    world.reset()
    _wait(torch)


def _wait(torch: Any) -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


@dataclass(frozen=True, kw_only=True)
class CamarConfig(PeerConfig):
    """Settings for measuring CAMAR."""

    reset_ratio: int = field(default=64, metadata=about("arenas that share a reset", 1, 2**20))


def camar_task(config: PeerConfig) -> dict[str, Any]:
    """Returns the task's settings for `camar_v0`, with lengths in m."""
    return {
        "map_generator": "random_grid",
        "dynamic": "DiffDriveDynamic",
        "dynamic_kwargs": {
            "linear_speed_min": 0.0,
            "linear_speed_max": epuck.MAX_SPEED,
            "angular_speed_min": -epuck.MAX_TURN_RATE,
            "angular_speed_max": epuck.MAX_TURN_RATE,
            "dt": DT,
        },
        "map_kwargs": {
            "num_agents": config.robots,
            "num_rows": CAMAR_CELLS,
            "num_cols": CAMAR_CELLS,
            "obstacle_density": 0.1,
            "obstacle_size": 0.2,
            "agent_rad_range": (epuck.HULL_RADIUS, epuck.HULL_RADIUS),
            "goal_rad_range": (0.05, 0.05),
        },
        "max_steps": config.step_limit,
        "frameskip": FRAMESKIP,
        "window": epuck.SENSOR_RANGE + epuck.HULL_RADIUS,
    }


def camar(words: Sequence[str]) -> Iterator[Line]:
    """Measures CAMAR; yields a JSON line for each number of arenas."""
    config = lines.load(CamarConfig, words)
    library = peers.find("camar", "the extra camar")
    wrappers = peers.find("camar.wrappers", "the extra camar")
    for arenas in config.arenas:
        ratio = min(config.reset_ratio, arenas)
        world = wrappers.OptimisticResetVecEnvWrapper(
            library.camar_v0(**camar_task(config)), arenas, reset_ratio=ratio
        )
        key = jax.random.key(config.seed)
        carry = (world.reset(key)[1], key)
        call = partial(_camar_steps, world, config)
        calls_s, compiled = peers.timed(call, carry, None, config.repeats)
        yield {
            "benchmark": "peer_camar.environment",
            "peer": "CAMAR random_grid",
            **peers.speed(config, arenas, FRAMESKIP + 1, calls_s),
            "reset_ratio": ratio,
            **compiled,
            **COUNTED["camar"],
            "settings": camar_task(config),
            **peers.with_jax("camar"),
        }


def _camar_steps(world: Any, config: PeerConfig, carry: Any, _: None) -> tuple[Any, jax.Array]:
    """Steps all arenas with random actions; also returns a sum that depends on every result."""

    def body(carry: Any, _: None) -> tuple[Any, jax.Array]:
        state, key = carry
        key, action_key, step_key = jax.random.split(key, 3)
        shape = (world.num_envs, config.robots, 2)
        action = jax.random.uniform(action_key, shape, minval=-1.0, maxval=1.0)
        seen, state, reward, _, _ = world.step(step_key, state, action)
        return (state, key), _sums((seen, reward))

    carry, rewards = jax.lax.scan(body, carry, length=config.steps)
    return carry, jnp.sum(rewards)


def _sums(results: Any) -> Array:
    """Sums results for each arena, [A], as our benchmark does."""
    sums = [jnp.sum(x, axis=tuple(range(1, x.ndim))) for x in jax.tree.leaves(results)]
    return functools.reduce(jnp.add, sums)


@dataclass(frozen=True, kw_only=True)
class JaxNavConfig(PeerConfig):
    """Settings for measuring JaxNav."""

    step: tuple[Literal["pool", "default"], ...] = field(
        default=("pool", "default"), metadata=about("how an ended episode starts again")
    )
    pool: int = field(default=1024, metadata=about("states in the pool", 1, 2**20))


def jaxnav_task(config: PeerConfig) -> dict[str, Any]:
    """Returns the task's settings for `jaxmarl.make`."""
    return {
        "num_agents": config.robots,
        "act_type": "Continuous",
        "rad": RADIUS,
        "lidar_num_beams": BEAMS,
        "lidar_max_range": RANGE,
        "lidar_range_resolution": RESOLUTION,
        "lidar_angle_factor": 1.0 - 1.0 / BEAMS,  # its range holds both ends: even spacing
        "map_id": "Grid-Rand-Poly",  # robots are squares of 0.5 m; 0.2.0 cannot step discs
        "map_params": {"map_size": (JAXNAV_CELLS, JAXNAV_CELLS), "fill": JAXNAV_FILL},
        "max_v": 1.0,
        "max_w": epuck.MAX_TURN_RATE,
        "max_v_acc": 1.0 / CONTROL_STEP,  # any command is reached in one control step, as in ours
        "max_w_acc": 2.0 * epuck.MAX_TURN_RATE / CONTROL_STEP,
        "goal_radius": 0.4,
        "dt": CONTROL_STEP,
        "max_steps": config.step_limit,
    }


def make_jaxnav(config: PeerConfig) -> Any:
    """Makes the environment; raises MissingPeerError if JaxMARL is not installed."""
    return peers.find("jaxmarl", "the extra jaxmarl").make("jaxnav", **jaxnav_task(config))


def jaxnav(words: Sequence[str]) -> Iterator[Line]:
    """Measures JaxNav; yields a JSON line for each number of arenas and each way to step."""
    config = lines.load(JaxNavConfig, words)
    world = make_jaxnav(config)
    pool = draw_pool(world, config.pool, config.seed)
    for arenas in config.arenas:
        for how in config.step:
            carry = (begin(pool, arenas)[1], jax.random.key(config.seed))
            call = partial(_jaxnav_steps, world, config, how)
            calls_s, compiled = peers.timed(call, carry, pool, config.repeats)
            yield {
                "benchmark": "peer_jaxnav.environment",
                "peer": f"JaxMARL JaxNav, {'step_env' if how == 'pool' else 'step'}",
                "reset": how,
                **peers.speed(config, arenas, 1, calls_s),
                **compiled,
                **COUNTED["jaxnav"],
                "resets": RESETS[how],
                "settings": jaxnav_task(config),
                **peers.with_jax("jaxmarl"),
            }


def draw_pool(world: Any, size: int, seed: int) -> tuple[Any, Any]:
    """Draws a pool of observations and states [P] at which episodes start."""
    keys = jax.random.split(jax.random.key(seed), size)
    return jax.jit(jax.vmap(world.reset))(keys)


def begin(pool: tuple[Any, Any], arenas: int) -> tuple[Any, Any]:
    """Takes observations and states [A] from the pool in order, and starts over at its end."""
    index = jnp.arange(arenas) % len(jax.tree.leaves(pool)[0])
    return jax.tree.map(lambda x: x[index], pool)


def step(
    world: Any, how: str, pool: tuple[Any, Any], keys: Array, states: Any, actions: Any
) -> tuple[Any, Any, Any, Any, Any]:
    """Steps all arenas, and resets the arenas whose episodes have ended.

    Args:
      world: the environment, JaxNav.
      how: the way to step and reset, a key of `RESETS`.
      pool: start states from `draw_pool`.
      keys: [A] random keys.
      states: [A] states.
      actions: each robot's actions [A, 2], by the robot's name.

    Returns:
      The results of JaxMARL's `step`, [A]: observations, states, rewards, dones and infos.
    """
    if how == "default":
        return jax.vmap(world.step)(keys, states, actions)
    size = len(jax.tree.leaves(pool)[0])
    index = jax.vmap(lambda key: jax.random.randint(key, (), 0, size))(keys)
    seen, moved, reward, done, info = jax.vmap(world.step_env)(keys, states, actions)
    over = done["__all__"]

    def choose(fresh: Array, old: Array) -> Array:
        return jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), fresh[index], old)

    seen, moved = jax.tree.map(choose, pool, (seen, moved))
    return seen, moved, reward, done, info


def _jaxnav_steps(
    world: Any, config: PeerConfig, how: str, carry: tuple[Any, Array], pool: Any
) -> tuple[tuple[Any, Array], Array]:
    """Steps all arenas with random actions; also returns a sum that depends on every result."""
    arenas = len(jax.tree.leaves(carry[0])[0])
    low, high = jnp.array([0.0, -epuck.MAX_TURN_RATE]), jnp.array([1.0, epuck.MAX_TURN_RATE])

    def body(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], Array]:
        states, key = carry
        key, action_key, step_key = jax.random.split(key, 3)
        drawn = low + (high - low) * jax.random.uniform(action_key, (config.robots, arenas, 2))
        actions = dict(zip(world.agents, drawn, strict=True))
        keys = jax.random.split(step_key, arenas)
        seen, states, reward, _, _ = step(world, how, pool, keys, states, actions)
        return (states, key), _sums((seen, reward))

    carry, rewards = jax.lax.scan(body, carry, length=config.steps)
    return carry, jnp.sum(rewards)
