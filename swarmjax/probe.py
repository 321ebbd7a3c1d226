"""`python -m swarmjax.probe stage=... key=value`: how often an untrained swarm succeeds by chance.

The probe takes the words of `swarmjax.train`, drives the networks that this training would begin
with, and writes no files. It says whether training on the last stage alone can begin.

Examples:
  # the default curriculum, stage by stage
  python -m swarmjax.probe
  # robots that are paid for arriving, and for nothing else
  python -m swarmjax.probe stage=s6 task.reward.progress=0 task.reward.arrival=1
  # more episodes, and so narrower intervals
  python -m swarmjax.probe stage=s6 episodes=4096
"""

import math
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from rich.console import Console
from rich.table import Table
from scipy.special import betaincinv

from swarmjax import command, provenance, words
from swarmjax.curriculum.engine import UNCOUNTED, Schedule
from swarmjax.evaluate import table as evaluate_table
from swarmjax.evaluate.statistics import CONFIDENCE, Interval
from swarmjax.run import compile_cache, memory
from swarmjax.run.load_settings import load_as
from swarmjax.run.settings import ProbeConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.episode import Ended
from swarmjax.training import loop, rollout
from swarmjax.training import program as programs
from swarmjax.training.rollout import Program

_HEADS = {"targets": "targets, %", "any": "a robot arrives, %", "all": "all arrive, %"}
_TAIL = (1 - CONFIDENCE) / 2
_DEVIATIONS = 1.96  # of a normal distribution, with a tail of 2.5 % on each side


class Counts(NamedTuple):
    """Sums over whole episodes, each [].

    Attributes:
      episodes: number of episodes.
      steps: their control steps.
      robots: robots that were present.
      targets: robots that had arrived at the end.
      visitors: robots that were within their targets at any time.
      any: episodes with at least one visitor.
      all: episodes in which all robots arrived.
    """

    episodes: Any
    steps: Any
    robots: Any
    targets: Any
    visitors: Any
    any: Any
    all: Any

    def share(self, what: str) -> Interval[float]:
        """Returns the chance of a robot (`targets`, `visitors`) or an episode (`any`, `all`)."""
        of = self.robots if what in ("targets", "visitors") else self.episodes
        return interval(self.episodes * getattr(self, what) / of, self.episodes)

    def expected(self, what: str, budget: int) -> Interval[float]:
        """Returns how many successes of the kind `what` to expect in a budget of control steps."""
        return Interval(*(p * budget * self.episodes / self.steps for p in self.share(what)))

    def deciding(self, what: str, budget: int) -> float:
        """Returns how many episodes would show whether the budget holds at least one success.

        This takes the counted chance as the true one. Its interval then excludes one success per
        budget. The interval is exact if no success was counted, else normal.
        """
        chance, one = self.share(what).estimate, self.steps / (budget * self.episodes)
        if not chance:
            return -math.log(_TAIL) / one
        return _DEVIATIONS**2 * chance / (chance - one) ** 2 if chance != one else math.inf

    def product(self, budget: int) -> float:
        """Returns at most how many episodes to expect with all robots at their targets at once.

        In such an episode, every robot is a visitor. So the chance is at most that of one visitor
        to the power of the number of robots, if each robot comes to its target independently of the
        others.
        """
        chance = self.share("visitors").high ** (self.robots / self.episodes)
        return chance * budget * self.episodes / self.steps


def interval(successes: float, trials: int) -> Interval[float]:
    """Computes a chance with its exact interval (Clopper & Pearson 1934).

    Args:
      successes: number of successes. It may be a sum of shares between 0 and 1, whose interval is
        too wide rather than too narrow, since shares vary less than successes of the same mean.
      trials: number of trials.
    """
    failures = trials - successes
    low = betaincinv(successes, failures + 1, _TAIL) if successes > 0 else 0.0
    high = betaincinv(successes + 1, failures, 1 - _TAIL) if failures > 0 else 1.0
    return Interval(successes / trials, float(low), float(high))


def probe(settings: ProbeConfig) -> list[Counts]:
    """Drives the untrained swarm on every stage.

    Args:
      settings: what would be trained, and how many episodes to count.

    Returns:
      The counts of each stage, over at least `settings.episodes` whole episodes.

    Raises:
      ConfigError: an extension does not fit, or memory is full.
    """
    config = _of_one_episode(settings)
    stages, rounds = len(config.stage), -(-settings.episodes // config.arenas)
    with memory.refusal(config), compile_cache.use():
        program, schedule = programs.load(config, by_robot=True)
        call = _compile(program, schedule)

        def one(number: int) -> Counts:
            key = jax.random.fold_in(jax.random.key(config.seed), number)
            return jax.device_get(call(schedule, np.int32(number % stages), key))

        # A call keeps one core of a CPU busy.
        on_cpu = jax.default_backend() == "cpu"
        with ThreadPoolExecutor(provenance.cores() if on_cpu else 1) as pool:
            counted = np.array(list(pool.map(one, range(rounds * stages))), np.int64)
    return [Counts(*each.tolist()) for each in counted.reshape(rounds, stages, -1).sum(axis=0)]


def _of_one_episode(settings: ProbeConfig) -> ProbeConfig:
    """Returns the settings of a program whose rollout is as long as an episode may take."""
    arenas, steps = min(settings.arenas, settings.episodes), settings.task.step_limit
    algo = replace(settings.algo, rollout_length=steps, num_minibatches=1)
    settings = replace(settings, seeds=1, seeds_by="vmap", devices=1, streams=None)
    return replace(settings, algo=algo, arenas=arenas, budget=arenas * steps)


def _compile(program: Program[ProbeConfig], schedule: Schedule) -> Any:
    """Compiles `play` once for all stages."""
    stage, key = np.int32(0), jax.random.key(0)
    options = programs.compiler_options(deterministic=program.config.run.deterministic)
    return jax.jit(partial(play, program)).lower(schedule, stage, key).compile(options)


def play(program: Program, schedule: Schedule, stage: Array | np.int32, key: Array) -> Counts:
    """Plays one whole episode in each arena, on new levels, with the networks before training.

    An arena that ends early goes on with another episode, which does not count. Otherwise short
    episodes would count more often than long ones.

    Args:
      program: a program whose rollout is as long as an episode may take.
      schedule: provides the stages.
      stage: [] index of the stage, int32.
      key: random key, consumed.
    """
    level_key, action_key = jax.random.split(key)
    following = jnp.full((1, program.config.arenas), stage)
    recall = program.ppo.begin_memory((program.world.spacing.robots,))
    starts = rollout.draw_starts(
        program.world, schedule.stages, following, jnp.int32(0), level_key, memory=recall
    )
    later = replace(starts, cohort=jnp.full_like(starts.cohort, UNCOUNTED))
    # Without its count, the schedule of exploration keeps the initial deviation.
    learners = replace(loop.init(program, schedule).learners, explored=None)
    _, _, ended = rollout.collect(program, learners, starts, later, action_key)
    return count(ended)


def count(ended: Ended) -> Counts:
    """Sums over the ended episodes [T, A] that count; `ended` has `robots`."""
    assert ended.robots is not None
    outside = ended.robots.robot_steps == ended.steps[..., None]
    visited = ended.robots.present & (ended.robots.reached | ~outside)
    counts = Counts(
        episodes=ended.episodes,
        steps=ended.steps,
        robots=ended.targets,
        targets=ended.reached,
        visitors=jnp.sum(visited, axis=-1),
        any=jnp.any(visited, axis=-1),
        all=ended.all_reached,
    )
    mine = ended.cohort >= 0
    return Counts(*(jnp.sum(jnp.where(mine, x, 0), dtype=jnp.int32) for x in counts))


def paid(task: TaskConfig) -> str:
    """Returns which episodes pay a reward for arriving: those with `any` visitor, or with `all`."""
    in_time = task.reward.step_penalty != 0  # paid for each step, also with `hold`
    together = task.arrival == "hold" or task.goal == "gather"
    return "all" if together and not in_time else "any"


def _holds(task: TaskConfig) -> bool:
    """Returns whether robots are paid only if all are within their targets at the same time."""
    return task.arrival == "hold" and paid(task) == "all"


def _table(settings: ProbeConfig, counts: Sequence[Counts], console: Console) -> Table:
    """Makes the table with a row for each stage."""
    signal = paid(settings.task)
    columns = list(dict.fromkeys([settings.curriculum.success, signal]))
    heads = ["stage", "robots", "episodes", *(_HEADS[each] for each in columns)]
    more = ["at most, if independent"] if _holds(settings.task) else []
    heads += ["control steps", "paid in the budget", *more]
    table = evaluate_table.make_table(console, *heads)
    for stage, each in zip(settings.stage, counts, strict=True):
        shares = (Interval(*(100 * p for p in each.share(what))) for what in columns)
        shown = ("{:.1f} [{:.1f}, {:.1f}]".format(*share) for share in shares)
        found = [_number(x) for x in each.expected(signal, settings.budget)]
        expected = "{} [{}, {}]".format(*found)
        about = (stage.name, str(stage.robots), f"{each.episodes:,}")
        most = [_number(each.product(settings.budget)) for _ in more]
        table.add_row(*about, *shown, f"{each.steps / each.episodes:.0f}", expected, *most)
    return table


def conclusion(settings: ProbeConfig, counts: Sequence[Counts]) -> str:
    """Says what the reward needs, and whether training on the last stage alone can begin."""
    reward, name, last = settings.task.reward, settings.stage[-1].name, counts[-1]
    signal, begins = paid(settings.task), f"training on {name} alone can begin."
    on_the_way = [
        f"task.reward.{key}" for key in ("progress", "path_progress") if getattr(reward, key) > 0
    ]
    if on_the_way:
        return f"{' and '.join(on_the_way)} pays before any robot arrives: {begins}"
    holds = _holds(settings.task)
    at_once = "all robots are within their targets at once" if holds else "all robots arrive"
    need = {"any": "a robot arrives", "all": at_once}[signal]
    nothing = "Apart from task.reward.extra, nothing" if any(reward.extra.values()) else "Nothing"
    found = [each.expected(signal, settings.budget) for each in counts]
    about, low, high = (_number(x) for x in found[-1])
    says = f"{nothing} is paid until {need}. Chance gives"
    if found[-1].low >= 1:
        return f"{says} about {about} such episodes in the budget ({low} to {high}): {begins}"
    able = [each.name for each, n in zip(settings.stage, found, strict=True) if n.low >= 1]
    first = f", which can begin on {able[0]}" if able else ""
    use = f"use a curriculum (docs/curriculum.md){first}."
    if found[-1].high < 1:
        return f"{says} fewer than {high} such episodes in the budget: {use}"
    most = last.product(settings.budget)
    if holds and not last.all and most < 1:
        return (
            f"{says} none in {last.episodes:,} episodes, and fewer than {_number(most)} in the "
            f"budget if each robot comes to its target independently of the others: {use}"
        )
    enough = _number(last.deciding(signal, settings.budget))
    return (
        f"{says} {low} to {high} such episodes in the budget, which leaves {name} alone undecided: "
        f"give about {enough} episodes to decide, or {use}"
    )


def _number(value: float) -> str:
    """Rounds to two digits."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:,.0f}" if rounded >= 10 else f"{rounded:g}"


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = load_as(ProbeConfig, arguments)
    console, say = evaluate_table.console(), words.say
    say(f"untrained swarm of seed {settings.seed}; a budget of {settings.budget:,} control steps")
    counts = probe(settings)
    console.print(_table(settings, counts, console))
    say(conclusion(settings, counts))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("probe", main, ProbeConfig))
