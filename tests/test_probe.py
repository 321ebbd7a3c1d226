"""Tests the probe: whole episodes of an untrained swarm, their chances, and what it concludes."""

import dataclasses
import sys
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from swarmjax import command, probe
from swarmjax.curriculum.engine import Schedule
from swarmjax.ppo.networks import Params
from swarmjax.ppo.ppo import LearnerState
from swarmjax.probe import Counts
from swarmjax.run.load_settings import load_as
from swarmjax.run.settings import ProbeConfig, TrainConfig
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.episode import Ended, Robots
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import rollout
from swarmjax.training.rollout import Program

EPISODES, LIMIT = 12, 300  # two rounds of the tiny configuration's 8 arenas
SPARSE = RewardConfig(progress=0.0, arrival=1.0, contact=0.0, step_penalty=0.0)


@pytest.fixture(scope="module")
def settings(tiny_config: TrainConfig) -> ProbeConfig:
    """Returns a probe of two stages whose targets are large, so that some episodes end early."""
    given = {each.name: getattr(tiny_config, each.name) for each in dataclasses.fields(TrainConfig)}
    task = TaskConfig(step_limit=LIMIT, target_radius=0.1, reward=SPARSE)
    stages = (StageConfig(name="one", robots=1, side=0.4), tiny_config.stage[1])
    own = {"stage": stages, "task": task, "episodes": EPISODES}
    return ProbeConfig(**(given | own))


# Chances


def test_ends_of_an_interval_without_success_or_failure_are_powers() -> None:
    # No success in n trials has the chance (1 - p)^n, which is 0.025 at the end of the interval.
    assert probe.interval(0, 100) == pytest.approx((0.0, 0.0, 1 - 0.025**0.01), rel=1e-12)
    assert probe.interval(100, 100) == pytest.approx((1.0, 0.025**0.01, 1.0), rel=1e-12)


@pytest.mark.parametrize(("successes", "trials"), [(1, 3), (5, 10), (3, 512)])
def test_an_interval_is_exact(successes: int, trials: int) -> None:
    exact = stats.binomtest(successes, trials).proportion_ci(method="exact")
    ends = (successes / trials, exact.low, exact.high)
    assert probe.interval(successes, trials) == pytest.approx(ends, rel=1e-9)


def test_a_budget_holds_the_chance_times_its_episodes() -> None:
    counts = Counts(episodes=100, steps=40_000, robots=300, targets=60, visitors=90, any=50, all=0)
    assert counts.share("targets").estimate == pytest.approx(0.2)
    assert counts.share("visitors").estimate == pytest.approx(0.3)
    # 1,000,000 steps are 2,500 episodes of 400.
    assert counts.expected("any", 1_000_000).estimate == pytest.approx(1250)
    assert counts.expected("all", 1_000_000).high == pytest.approx(2500 * (1 - 0.025**0.01))
    # Three robots, each a visitor with at most the upper end of 30 of 100.
    high = stats.binomtest(30, 100).proportion_ci(method="exact").high
    assert counts.product(1_000_000) == pytest.approx(2500 * high**3)


# Counting


def _ended(arena: list[list[int]], robots: Robots) -> Ended:
    """Returns ended episodes [T, A] from their steps, 0 where none ended; the first one counts."""
    steps = np.array(arena, np.int32)
    over = steps > 0
    first = over & (np.cumsum(over, axis=0) == 1)
    reached = np.sum(robots.reached, axis=-1)
    targets = np.where(over, 2, 0)
    return Ended(
        episodes=over.astype(np.int32),
        stage=steps * 0,
        cohort=np.where(first, 0, np.where(over, -2, -1)),
        targets=targets,
        reached=reached,
        all_reached=(over & (reached == targets)).astype(np.int32),
        steps=steps,
        robot_steps=steps,
        sensed=steps,
        contacts=steps[..., None],
        reward=steps,
        broken=steps * 0,
        robots=robots,
    )


def test_an_arena_that_ends_early_counts_once() -> None:
    # Arena 0 plays three episodes of one step, and both robots arrive in each. Arena 1 plays one
    # episode of three steps, in which robot 0 leaves its target again.
    there = np.zeros((3, 2, 2), bool)
    there[:, 0] = True
    moving = np.zeros((3, 2, 2), np.int32)
    moving[:, 0], moving[2, 1] = 1, (2, 3)
    robots = Robots(np.ones((3, 2, 2), bool), there, moving, moving, moving, moving)
    ended = _ended([[1, 0], [1, 0], [1, 3]], robots)
    found = jax.tree.map(int, probe.count(jax.tree.map(jnp.asarray, ended)))
    assert found == Counts(episodes=2, steps=4, robots=4, targets=2, visitors=3, any=2, all=1)


def test_each_arena_counts_its_first_episode_with_the_networks_that_training_begins_with(
    settings: ProbeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[Params, Ended]] = []
    programs: list[Program] = []
    traced: list[Params] = []

    def collect(program: Program, learners: LearnerState, *rest: Any) -> Any:
        traced.append(learners.params)
        return whole[0](program, learners, *rest)

    def compiled(program: Program, schedule: Schedule) -> Any:
        programs.append(program)
        call = whole[1](program, schedule)

        def one(*given: Any) -> Counts:
            counts, *more = call(*given)
            seen.append(jax.device_get(more))
            return counts

        return one

    whole = rollout.collect, probe._compile, probe.count
    monkeypatch.setattr(rollout, "collect", collect)
    monkeypatch.setattr(probe, "count", lambda ended: (whole[2](ended), traced[0], ended))
    monkeypatch.setattr(probe, "_compile", compiled)
    chex.clear_trace_counter()
    monkeypatch.setattr(probe, "play", chex.assert_max_traces(probe.play, n=1))
    counts = probe.probe(settings)

    assert len(seen) == 4  # two rounds of two stages
    every = [ended for _, ended in seen]
    for stage, found in enumerate(counts):
        firsts = [_first(each) for each in every if each.stage.max() == stage]
        assert (found.episodes, found.robots) == (16, 16 * settings.stage[stage].robots)
        assert found.steps == sum(each["steps"] for each in firsts)
        assert found.targets == sum(each["reached"] for each in firsts)
        assert found.all == sum(each["all_reached"] for each in firsts)
        assert found.visitors == found.targets  # with `latch`
    # Some arenas ended more than one episode, so a count of all episodes would differ.
    assert sum(each.episodes.sum() for each in every) > 32

    key = jax.random.split(jax.random.key(settings.seed), 3)[1]  # as `loop.init` splits it
    first = jax.vmap(programs[0].ppo.init)(jax.random.split(key, 1)).params
    chex.assert_trees_all_close(seen[0][0], first, rtol=1e-5, atol=1e-7)


def _first(ended: Ended) -> dict[str, int]:
    """Sums over the first episode that ended in each arena."""
    first = np.argmax(ended.episodes, axis=0)
    assert ended.episodes.any(axis=0).all()
    every = np.arange(len(first))
    return {
        name: int(getattr(ended, name)[first, every].sum())
        for name in ("steps", "reached", "all_reached")
    }


# Conclusions


def _counts(**given: int) -> Counts:
    """Returns the counts of 500 episodes of 400 steps with 10 robots."""
    zero = dict.fromkeys(("targets", "visitors", "any", "all"), 0)
    return Counts(**({"episodes": 500, "steps": 200_000, "robots": 5_000} | zero | given))


@pytest.mark.parametrize(
    ("words", "given", "sentence"),
    [
        ([], {}, "task.reward.progress pays before any robot arrives: training on s6 alone can "
         "begin."),
        (["task.reward.progress=0"], {"any": 50},
         "Nothing is paid until a robot arrives. Chance gives about 750 such episodes in the "
         "budget (560 to 970): training on s6 alone can begin."),
        (["task.reward.progress=0"], {},
         "Nothing is paid until a robot arrives. Chance gives 0 to 55 such episodes in the "
         "budget. It is unclear if training on s6 alone can begin: give episodes of about "
         "28,000, or use a curriculum (docs/curriculum.md)."),
        (["task.reward.progress=0", "budget=1e4"], {},
         "Nothing is paid until a robot arrives. Chance gives fewer than 0.18 such episodes in the "
         "budget: use a curriculum (docs/curriculum.md)."),
        # 100 visitors of 5,000 robots are at most 3.65 %; 0.0365^10 of 7,500 episodes is 3.1e-11.
        (["task.reward.progress=0", "task.reward.step_penalty=0", "task.arrival=hold"],
         {"visitors": 100, "any": 90},
         "Nothing is paid until all robots are within their targets at once. Chance gives none in "
         "500 episodes, and fewer than 3.1e-11 in the budget if each robot comes to its target "
         "independently of the others: use a curriculum (docs/curriculum.md)."),
    ],
)  # fmt: skip
def test_what_is_concluded(words: list[str], given: dict[str, int], sentence: str) -> None:
    settings = load_as(ProbeConfig, ["stage=s6", "arenas=8", *words])
    assert probe.conclusion(settings, [_counts(**given)]) == sentence


def test_a_curriculum_begins_where_chance_succeeds() -> None:
    words = ["stage.sequence=[s1,s3,s6]", "task.reward.progress=0"]
    settings = load_as(ProbeConfig, words)
    counts = [_counts(), _counts(any=90), _counts()]
    assert probe.conclusion(settings, counts).endswith(
        "use a curriculum (docs/curriculum.md), which can begin on s3."
    )


# The command


def _main(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["probe", *words])
    return command.run("probe", probe.main, ProbeConfig)


def test_the_command_shows_a_row_for_each_stage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(probe, "probe", lambda _: [_counts(targets=500, any=250), _counts()])
    assert _main(monkeypatch, "stage.sequence=[s1,s6]", "seed=7") == 0
    about, head, *rows = capsys.readouterr().out.splitlines()
    assert about == "untrained swarm of seed 7; a budget of 3,000,000 control steps"
    assert head.split("  ")[1:3] == ["robots", "episodes"]
    assert [row.split()[:3] for row in rows[:2]] == [["s1", "2", "500"], ["s6", "5", "500"]]
    assert "10.0 [7.5, 13.0]" in rows[0]
    assert "50.0 [45.5, 54.5]" in rows[0]
    assert rows[-1].endswith("training on s6 alone can begin.")


def test_with_hold_the_table_multiplies_the_chances_of_single_robots(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(probe, "probe", lambda _: [_counts(visitors=100, any=90)])
    words = ["task.arrival=hold", "task.reward.step_penalty=0", "curriculum.success=all"]
    assert _main(monkeypatch, "stage=s6", *words) == 0
    _, head, row, *_ = capsys.readouterr().out.splitlines()
    assert head.rstrip().endswith("all arrive, %  control steps  paid in the budget  "
                                  "at most, if independent")  # fmt: skip
    assert row.split() == ["s6", "5", "500", "0.0", "[0.0,", "0.7]", "400", "0", "[0,", "55]",
                           "3.1e-11"]  # fmt: skip


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("episods=3", "episods is not a key: did you mean episodes?"),
        ("episodes=0", "episodes is 0: give 1 to 2147483647."),
        ("init_from=a", "init_from is 'a', but a probe drives an untrained swarm: leave init_from "
         "out."),
    ],
)  # fmt: skip
def test_what_is_refused_is_one_sentence(
    word: str,
    sentence: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _main(monkeypatch, word) == 2
    assert capsys.readouterr().err == f"swarmjax.probe: error: {sentence}\n"
