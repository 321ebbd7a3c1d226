"""Tests the study of curricula: arms, points, measures, and tables worked out by hand."""

import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from sentences import refusal

from benchmarks import curriculum, curriculum_arms, curriculum_table, learners_judge
from benchmarks.curriculum_arms import StudyConfig
from benchmarks.curriculum_table import Key
from swarmjax import command
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.ppo import learner as ppo
from swarmjax.ppo.learner import LearnerState
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.task import level, observation
from swarmjax.task import stage as task_stage
from swarmjax.training import program as programs

HARD = ("crowd", "crowd_dense", "dense", "narrow")
ROOM = ["sim.max_robots=10", "sim.max_obstacles=8"]

# --- arms


def test_words_of_the_study_are_told_from_those_of_training() -> None:
    words = ["arms=final,mixed", "seeds=4", "goal=crowd", "points=3", "curriculum.threshold=0.9"]
    study, rest = curriculum_arms.parse(words)
    assert study == StudyConfig(arms=("final", "mixed"), goal="crowd", points=3)
    assert rest == ["seeds=4", "curriculum.threshold=0.9"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["stage=s6"], "stage cannot be given: choose it by goal"),
        (["curriculum.mode=mixed"], "curriculum.mode cannot be given: choose it by arms"),
        (["arms=final,none"], "arms is 'none': give final, sequential"),
        (["points=1"], "points is 1"),
        (["label=x"], "label is x, but arms names 4 arms"),
    ],
)
def test_unsound_words_are_refused(words: list[str], expected: str) -> None:
    assert expected in refusal(curriculum_arms.parse, words)


@pytest.mark.parametrize(
    ("arm", "mode", "stages"),
    [
        ("final", "mixed", ["s6"]),
        ("sequential", "sequential", ["s1", "s2", "s3", "s4", "s5", "s6"]),
        ("mixed", "mixed", ["s1", "s2", "s3", "s4", "s5", "s6"]),
        ("adaptive", "adaptive", ["s1", "s2", "s3", "s4", "s5", "s6"]),
    ],
)
def test_arms_differ_in_mode_and_stages_alone(arm: str, mode: str, stages: list[str]) -> None:
    made = curriculum_arms.load_arm(StudyConfig(), arm, "independent", ["arenas=16", "budget=1e6"])
    assert made.curriculum.mode == mode
    assert [stage.name for stage in made.stage] == stages
    same = replace(made, stage=made.stage[-1:], curriculum=CurriculumConfig(), stage_name="s6")
    assert same == load_train(
        ["stage=s6", "seeds=10", "arenas=16", "budget=1e6", "algo.policy=independent"]
    )


def test_the_grid_ends_in_the_goal() -> None:
    last = curriculum_arms.load_arm(StudyConfig(), "adaptive-grid", "shared", []).stage[-1]
    (goal,) = load_train(["stage=s6"]).stage
    assert replace(last, name="s6") == goal


@pytest.mark.parametrize("goal", HARD)
def test_a_hard_goal_ends_its_own_curriculum(goal: str) -> None:
    study = StudyConfig(goal=goal)
    (alone,) = curriculum_arms.load_arm(study, "final", "shared", ROOM).stage
    stages = curriculum_arms.load_arm(study, "mixed", "shared", ROOM).stage
    assert stages[-1] == alone
    # An arena of 1.5 m is held out.
    assert max(side for stage in stages for side in stage.sides) <= 1.2
    for key in ("robots", "obstacles"):
        numbers = [getattr(stage, key) for stage in stages]
        assert numbers == sorted(numbers)  # the easiest first


@pytest.mark.parametrize("name", [*HARD, "crowd7", "dense5", "narrow2"])
def test_levels_of_hard_stages_leave_nothing_out(name: str) -> None:
    (stage,) = load_train([*ROOM, f"stage={name}"]).stage
    one = task_stage.select(task_stage.stack([stage]), np.intp(0))
    spacing = level.Spacing(stage.robots, stage.obstacles, 0.037, 0.05)
    random = np.random.default_rng(0)
    for _ in range(30):
        uniforms = random.random(level.uniform_count(spacing), dtype=np.float32)
        drawn = level.sample(uniforms, one, spacing, np)
        assert drawn.present.all()
        assert drawn.obstacle_present.all()
        assert np.abs(drawn.obstacle[:, :2]).max() < 0.6  # no obstacle is parked outside


def test_points_are_even_in_the_logarithm() -> None:
    # 16 arenas of 32 control steps make updates of 512 arena steps. So 1e5 arena steps are 195.3
    # updates, and 1e6 arena steps are 1953.1 updates.
    trained = load_train(["arenas=16", "budget=1e6"])
    found = curriculum_arms.points(StudyConfig(points=3, first=100_000), trained)
    # The middle point is at update sqrt(195 * 1953) = 617.1.
    np.testing.assert_array_equal(found, [195, 617, 1953])
    few = curriculum_arms.points(StudyConfig(points=9, first=1), replace(trained, budget=512 * 4))
    np.testing.assert_array_equal(few, [1, 2, 3, 4])  # nine points fall on four updates
    sentence = refusal(curriculum_arms.points, StudyConfig(first=10**6), trained)
    assert "give less than 999936" in sentence  # 1953 * 512


def test_the_held_out_arena_is_for_swarms_of_its_size() -> None:
    five = load_train(["stage=s6"])
    found = curriculum_arms.roles(StudyConfig(), five, [])
    names = {role: (stage.name, stage.sides) for role, stage in found.items()}
    assert names == {
        "goal": ("s6", (1.2, 1.2)),
        "first": ("s1", (0.5, 0.5)),
        "held_out": ("expanded", (1.5, 1.5)),
    }
    ten = load_train([*ROOM, "stage=crowd"])
    # With ten robots there is neither a held-out arena nor a first stage to judge: the baseline
    # trains only with ten robots.
    assert curriculum_arms.roles(StudyConfig(goal="crowd"), ten, ROOM).keys() == {"goal"}


def test_the_grid_is_for_its_own_goal() -> None:
    sentence = refusal(curriculum_arms.parse, ["goal=dense", "arms=adaptive-grid"])
    assert sentence == (
        "arms holds adaptive-grid, whose last cell is s6, but goal is dense: give goal=s6, or "
        "other arms."
    )


# --- measuring


@pytest.fixture(scope="module")
def trained(tiny_config: TrainConfig) -> TrainConfig:
    return replace(tiny_config, seeds=3, budget=8 * 8 * 6)


def _count(learners: LearnerState) -> dict[str, dict[str, np.ndarray]]:
    """Stands in for a judge: returns how many transitions each policy's normaliser has seen."""
    return {"goal": {"targets_reached": np.asarray(learners.normalizer.count[:, 0])}}


@pytest.mark.slow
def test_an_arm_is_judged_at_its_points(trained: TrainConfig) -> None:
    at = np.array([1, 2, 5])
    curves = curriculum.measure(trained, at, _count)
    seen = np.array(curves.judged["goal"]["targets_reached"])
    np.testing.assert_array_equal(seen, curves.transitions)
    assert (seen[:, 0] > 0).all()
    # An update has 8 arenas of two or three robots and 8 control steps. Robots that arrive early
    # add fewer transitions.
    assert (np.diff(seen, prepend=0) <= 8 * 3 * 8 * np.diff(at, prepend=0)).all()
    assert np.array(curves.stage).shape == (3, 3)
    np.testing.assert_allclose(np.sum(curves.mix, axis=1), 1.0, atol=3e-4)  # rounded to 1e-4
    assert (np.diff(curves.train_s, prepend=0.0) > 0).all()
    assert curves.broken_arenas == 0


def test_the_judge_gives_means_by_seed_and_stage(trained: TrainConfig) -> None:
    judged = {"goal": trained.stage[1], "first": trained.stage[0]}
    study = StudyConfig(levels=4, level_seed=5)
    keys = jax.random.split(jax.random.key(0), (2, 1))
    sizes = (observation.SIZE, programs.ACTION_SIZE, 1)
    start = jax.vmap(jax.vmap(lambda key: ppo.init(key, trained.algo, *sizes)))
    learners = start(keys)
    # Untrained policies hardly move, so a bias makes both seeds drive ahead, at different speeds.
    learners.params["actor"]["mean"]["bias"] += np.array([[[1.0, 0.0]], [[0.5, 0.3]]], np.float32)
    found = curriculum.load_judge(study, trained, judged)(learners)
    world = programs.load_world(
        replace(trained, arenas=4, algo=replace(trained.algo, num_minibatches=1))
    )
    alone = jax.jit(
        partial(learners_judge.outcomes, world, trained.algo, steps=trained.task.step_limit)
    )
    for role, stage in judged.items():
        levels = learners_judge.draw_levels(world, stage, 5, 4)
        for seed in range(2):
            outcome = alone(jax.tree.map(lambda x, i=seed: x[i], learners), levels)
            for name, values in outcome._asdict().items():
                # Batched matrix products round differently.
                expected = np.asarray(values).mean()
                np.testing.assert_allclose(found[role][name][seed], expected, atol=1e-5)
    assert found["first"]["contacts_per_robot"].max() > 0.0


# --- tables

STEPS = [10_000, 100_000, 1_000_000]
GOAL = [[0.2, 0.6, 1.0], [0.2, 0.4, 0.8], [0.0, 0.2, 0.6], [0.4, 0.8, 0.9]]
FIRST = [[0.9, 1.0, 0.7], [0.9, 0.8, 1.0], [1.0, 0.9, 0.9], [0.5, 0.6, 0.5]]
KEY = Key(goal="s6", policy="shared", arenas=16, budget=1_000_000)


def _line(arm: str, goal: list = GOAL, **rest: Any) -> dict[str, Any]:
    return {
        "benchmark": "curriculum",
        "arm": arm,
        **KEY._asdict(),
        "arena_steps": STEPS,
        "levels": 4,
        "level_seed": 2,
        "steps": 500,
        "robot": "planar",
        "realism": "ideal",
        "roles": {"goal": "s6", "first": "s1"},
        "judged": {
            "goal": {"targets_reached": goal, "all_reached": FIRST},
            "first": {"targets_reached": FIRST, "all_reached": goal},
        },
        **rest,
    }


def _without_first(arm: str) -> dict[str, Any]:
    judged = {"goal": _line(arm)["judged"]["goal"]}
    return _line(arm, roles={"goal": "s6"}, judged=judged)


def test_figures_by_hand() -> None:
    found = curriculum_table.figures(_line("mixed"), "targets_reached")
    np.testing.assert_allclose(found.goal, [1.0, 0.8, 0.6, 0.9])
    assert found.held_out is None
    # Curves are interpolated linearly: at 550,000 steps the first seed is half-way from 0.6 to 1.
    np.testing.assert_allclose(found.steps[0.8], [550_000, 1_000_000, np.inf, 100_000])
    # At 775,000 steps the first seed is three quarters of the way from 0.6 to 1.
    np.testing.assert_allclose(found.steps[0.9], [775_000, np.inf, np.inf, 1_000_000])
    # The trapezoids span 90,000 and 900,000 steps: 1/11 and 10/11 of the whole span.
    np.testing.assert_allclose(found.area[0], (0.4 + 10 * 0.8) / 11)
    # On the logarithmic axis each trapezoid spans one decade.
    np.testing.assert_allclose(found.log_area, [0.6, 0.45, 0.25, 0.725])
    assert found.forgotten is not None
    np.testing.assert_allclose(found.forgotten, [0.3, 0.0, 0.1, 0.1])
    other = curriculum_table.figures(_line("mixed"), "all_reached")
    np.testing.assert_allclose(other.goal, [0.7, 1.0, 0.9, 0.5])


def test_table_by_hand() -> None:
    # Every seed of the better arm ends higher than any seed of the baseline, and learns sooner.
    better = [[0.9, 1.0, 1.0]] * 4
    worse = [[0.0, 0.1, 0.5]] * 4
    arms = curriculum_table.tables([_line("mixed", better), _line("final", worse)])
    assert list(arms) == [KEY]
    text = curriculum_table.table(KEY, arms[KEY], "targets_reached").splitlines()
    assert text[0] == "### s6, shared, 16 arenas, 1,000,000 arena steps: targets reached"
    assert text[2].startswith("| arm | goal | 1.5 m | to 0.8 | to 0.9 | area |")
    baseline, mixed = ([cell.strip() for cell in row.split("|")[1:-1]] for row in text[4:])
    # All seeds are equal, so intervals have no width. Areas over steps: (0.05 + 10 * 0.3) / 11 for
    # the baseline, and (0.95 + 10) / 11 for the better arm.
    never, soon = "never (never to never)", "10,000 (10,000 to 10,000)"
    assert baseline[:5] == ["final", "0.500 (0.500 to 0.500)", "-", never, never]
    assert baseline[5].startswith("0.277")
    assert mixed[:5] == ["mixed", "1.000 (1.000 to 1.000)", "-", soon, soon]
    assert mixed[5].startswith("0.995")
    assert mixed[7].startswith("0.100")  # the mean of the middle two of 0.3, 0, 0.1 and 0.1
    assert baseline[8:] == ["-", "-"]
    assert mixed[8:] == ["1.00 (1.00 to 1.00)"] * 2


def test_arms_that_were_not_judged_on_the_first_stage_have_a_dash() -> None:
    without = _without_first("final")
    arms = curriculum_table.tables([_line("mixed"), without])[KEY]
    assert curriculum_table.figures(without, "targets_reached").forgotten is None
    text = curriculum_table.table(KEY, arms, "targets_reached").splitlines()
    forgotten = {row.split("|")[1].strip(): row.split("|")[8].strip() for row in text[4:]}
    assert forgotten["final"] == "-"
    assert forgotten["mixed"].startswith("0.100")  # the mean of the middle two of the four seeds
    axes = Figure().subplots()
    curriculum_table._draw_curves(axes, arms, "first", "targets_reached")
    assert [line.get_label() for line in axes.get_lines()] == ["mixed"]
    assert axes.get_title() == "s1 (first stage)"


def test_all_judged_stages_are_drawn_whichever_arm_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    monkeypatch.setattr(
        curriculum_table, "_draw_curves", lambda axes, arms, role, measure: drawn.append(role)
    )
    arms = curriculum_table.tables([_line("mixed"), _without_first("final")])[KEY]
    curriculum_table.draw(KEY, arms, "targets_reached", tmp_path / "a.png")
    assert drawn == ["goal", "first"]


def test_lines_that_do_not_compare_are_refused() -> None:
    twice = refusal(curriculum_table.tables, [_line("mixed"), _line("mixed")])
    assert "arm mixed of s6, shared" in twice
    others = refusal(curriculum_table.tables, [_line("final"), _line("mixed", levels=5)])
    assert "final and mixed" in others
    assert "levels" in others
    roles = {"goal": "s6", "first": "s2"}
    assert "differ in roles" in refusal(
        curriculum_table.tables, [_line("final"), _line("mixed", roles=roles)]
    )
    apart = [_line("final"), _line("final", budget=5)]
    assert len(curriculum_table.tables(apart)) == 2


def test_curves_are_drawn_as_interquartile_means() -> None:
    axes = Figure().subplots()
    curriculum_table._draw_curves(axes, {"mixed": _line("mixed")}, "goal", "targets_reached")
    (drawn,) = axes.get_lines()
    np.testing.assert_array_equal(drawn.get_xdata(), STEPS)
    # The middle two of the four seeds have 0.2 and 0.2, then 0.4 and 0.6, then 0.8 and 0.9.
    np.testing.assert_allclose(np.asarray(drawn.get_ydata(), float), [0.2, 0.5, 0.85])
    assert axes.get_xscale() == "log"


def test_the_command_reads_files_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_text("".join(json.dumps(_line(arm)) + "\n" for arm in ("final", "mixed")))
    assert curriculum_table.main([str(path), f"out={tmp_path / 'figures'}"]) == 0
    assert capsys.readouterr().out.count("\n| ") == 4
    drawn = tmp_path / "figures" / "s6-shared-16-1000000-targets_reached.png"
    assert drawn.read_bytes()[:4] == b"\x89PNG"
    path.write_text('{"benchmark": "other"}\n')
    other = refusal(curriculum_table.main, [str(path)])
    assert other == f"{path} in line 1 is not a line of benchmarks.curriculum."
    assert "cannot be read" in refusal(curriculum_table.main, [str(tmp_path / "none.jsonl")])
    assert "no file is given" in refusal(curriculum_table.main, [])
    assert "measure is 'time'" in refusal(curriculum_table.main, [str(path), "measure=time"])


def _run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["curriculum_table", *words])
    return command.run("curriculum_table", curriculum_table.main, TrainConfig)


@pytest.mark.parametrize(
    ("key", "value", "what"),
    [
        ("arm", None, "has arm of another type: it is damaged."),
        ("budget", "1e6", "has budget of another type: it is damaged."),
        ("judged", {}, "has no judged.goal: it is damaged."),
        ("roles", {"goal": "s6"}, "has no roles.first: it is damaged."),
        ("arena_steps", [1, 2], "judged.goal.targets_reached: it is damaged."),
        ("arena_steps", [0, 1, 2], "judged.goal.targets_reached: it is damaged."),
        ("judged", {"goal": {}}, "judged.goal.targets_reached: it is damaged."),
        (
            "judged",
            {"goal": {"targets_reached": GOAL, "all_reached": [["0", "0", "1"]]}},
            "over arena_steps as judged.goal.all_reached: it is damaged.",
        ),
    ],
)
def test_a_damaged_line_is_named(key: str, value: object, what: str, tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_text(json.dumps(_line("final")) + "\n" + json.dumps(_line("mixed") | {key: value}))
    sentence = refusal(curriculum_table.read, path)
    assert sentence.startswith(f"{path} in line 2 has ")
    assert sentence.endswith(what)


def test_errors_of_the_table_are_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, file = tmp_path / "lines.jsonl", tmp_path / "file"
    file.write_text("")
    path.write_text(json.dumps(_line("final")))
    assert _run(monkeypatch, str(path), f"out={file}/x") == 2
    said = capsys.readouterr()
    # The plots cannot be written, so the tables are not printed either.
    expected = f"out is {file}/x, which cannot be written: Not a directory.\n"
    assert (said.out, said.err) == ("", f"swarmjax.curriculum_table: error: {expected}")
    line = _line("final")
    del line["arm"]
    path.write_text(json.dumps(line))
    assert _run(monkeypatch, str(path)) == 2
    expected = f"{path} in line 1 has no arm: it is damaged.\n"
    assert capsys.readouterr().err == f"swarmjax.curriculum_table: error: {expected}"
