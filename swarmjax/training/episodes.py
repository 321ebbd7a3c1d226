"""`run.episodes`: a line of `episodes.jsonl` for each episode that ended, robot by robot.

The compiled loop returns the episodes of a rollout packed: steps without an ended episode are left
out.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.task.env import EnvState
from swarmjax.task.episode import Ended, Robots
from swarmjax.training.config import STEPS_PER_EPISODE, ProgramConfig

KEY = "episodes_log"  # key in the metrics of an update
MOST_HELD = 2**19  # most episodes that a call may return, over all updates and seeds

Row = dict[str, Any]


class EpisodeLog(NamedTuple):
    """Episodes that ended in one update, in the order in which they ended, at most E.

    Attributes:
      ended: [] number of episodes, int32; if more than E, the last ones are lost.
      arena_steps: [E] control steps of all arenas since the update began, until the episode ended.
      stage: [E] index of the stage on which the episode began.
      steps: [E] control steps of the episode.
      robots: [E] outcome for each robot.
    """

    ended: Array
    arena_steps: Array
    stage: Array
    steps: Array
    robots: Robots


def room(config: ProgramConfig) -> int:
    """Returns how many episodes of one update and seed are kept at most.

    In an update, an arena can end its running episode and all of its waiting episodes. If fewer
    episodes wait than by default, the arena repeats the last one, so it needs as much room as by
    default. A short step limit ends more episodes. An arena ends at most one episode at each
    control step.
    """
    steps, limit = config.algo.rollout_length, config.task.step_limit
    usual = max(config.waiting, steps // STEPS_PER_EPISODE, steps // limit)
    return config.arenas * min(steps, usual + 1)


def rows_of_call(config: ProgramConfig) -> int:
    """Returns how many updates of each seed a call may have if it returns their episodes."""
    return max(1, MOST_HELD // (room(config) * config.seeds))


def robots(arenas: EnvState) -> Robots:
    """Returns the outcome for each robot, [A, R]."""
    present, episode = arenas.level.present, arenas.episode
    return Robots(
        present=present,
        reached=present & arenas.arrived,
        reward=episode.reward,
        robot_steps=episode.moving,
        sensed=episode.sensed,
        contacts=jnp.sum(episode.contacts, axis=-1),
    )


def pack(ended: Ended, size: int) -> EpisodeLog:
    """Drops all steps of arenas at which no episode ended.

    Args:
      ended: [T, A] counts of ended episodes, with `robots`.
      size: E.

    Returns:
      The episodes, ordered by the step at which they ended, then by arena; further entries are 0.
    """
    chex.assert_rank(ended.episodes, 2)
    assert ended.robots is not None
    arenas = ended.episodes.shape[1]
    over = jnp.ravel(ended.episodes) > 0
    index = jnp.nonzero(over, size=size, fill_value=over.size)[0]

    def take(x: Array) -> Array:
        flat = x.reshape(-1, *x.shape[2:])
        return jnp.take(flat, index, axis=0, mode="fill", fill_value=0)

    return EpisodeLog(
        ended=jnp.sum(over, dtype=jnp.int32),
        arena_steps=jnp.where(index < over.size, (index // arenas + 1) * arenas, 0),
        stage=take(ended.stage),
        steps=take(ended.steps),
        robots=jax.tree.map(take, ended.robots),
    )


def rows(
    log: EpisodeLog,
    updates: np.ndarray,
    stages: Sequence[str],
    seeds: Sequence[int],
    control_steps: int,
) -> tuple[list[Row], int]:
    """Turns the episodes of a call into rows for JSON.

    Args:
      log: [N, rows, ...]; the first n rows of each seed hold one update each.
      updates: [n] numbers of the updates, from 0.
      stages: names of the stages.
      seeds: [N] seeds of the run.
      control_steps: control steps of one update and seed, summed over all arenas.

    Returns:
      The rows, sorted by update, then by seed, then by the time at which the episode ended. Also
      the number of lost episodes.
    """
    found, lost = [], 0
    for i, update in enumerate(updates.tolist()):
        for lane, seed in enumerate(seeds):
            mine = jax.tree.map(lambda x, at=(lane, i): x[at], log)
            count, held = int(mine.ended), len(mine.steps)
            lost += max(0, count - held)
            begin = {"seed": seed, "update": update}
            before = update * control_steps
            found += [begin | _row(mine, each, stages, before) for each in range(min(count, held))]
    return found, lost


def _row(log: EpisodeLog, index: int, stages: Sequence[str], before: int) -> Row:
    """Describes one episode, with the robots that were present."""
    present = np.asarray(log.robots.present[index])
    values: Mapping[str, np.ndarray] = log.robots._asdict()
    by_robot = {
        name: np.asarray(value[index])[present].tolist()
        for name, value in values.items()
        if name != "present"
    }
    return {
        "arena_steps": before + int(log.arena_steps[index]),
        "stage": stages[int(log.stage[index])],
        "steps": int(log.steps[index]),
        "robots": int(present.sum()),
        **by_robot,
    }
