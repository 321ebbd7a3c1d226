"""Checks every default, every check and every message of the settings."""

import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sentences import refusal

from swarmjax import epuck
from swarmjax.command import help_text
from swarmjax.config import build, files, to_dict
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.export.config import ExportConfig
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import RobotConfig
from swarmjax.task.config import RewardConfig
from swarmjax.task.stage_config import StageConfig, smallest_side
from swarmjax.task.stage_files import load_levels

ROOT = Path(files.__file__).resolve().parents[2]
STAGE = {"name": "s", "robots": 2, "side": 1.0}
CHOICES = ", ".join(sorted(path.stem for path in (ROOT / "configs" / "stage").glob("*.yaml")))


# Defaults and stages


def test_stages_are_the_table_of_the_plan():
    table = {
        "s1": (2, 0.5, 0),
        "s2": (2, 0.7, 0),
        "s3": (3, 0.7, 1),
        "s4": (3, 1.0, 2),
        "s5": (5, 1.0, 2),
        "s6": (5, 1.2, 3),
        "expanded": (5, 1.5, 3),
    }
    for name, numbers in table.items():
        (stage,) = load_train([f"stage={name}"]).stage
        assert (stage.robots, stage.side, stage.obstacles) == numbers
        assert stage.name == name


def test_every_stage_file_can_be_trained():
    files = {path.stem for path in (ROOT / "configs" / "stage").glob("*.yaml")}
    assert files >= {"curriculum", "worlds", "expanded"}
    for name in files:
        train = load_train([f"stage={name}", "sim.max_robots=200", "sim.max_obstacles=50"])
        assert train.stage_name == name


def test_train_defaults_to_the_whole_curriculum():
    train = load_train([])
    assert [stage.name for stage in train.stage] == ["s1", "s2", "s3", "s4", "s5", "s6"]
    assert train.stage_name == "curriculum"
    # The files in configs/ change no default of the sections.
    assert train == TrainConfig(stage=train.stage, stage_name="curriculum")
    # 3e6 // (128 * 32) = 3e6 // 4096 = 732 updates, and the last whole update ends at
    # 732 * 4096 = 2,998,272 control steps.
    assert train.updates == 732
    assert train.learners == 1


def test_defaults_of_the_reward_are_equation_3_and_two_prices():
    weights = {name: weight for name, weight in vars(RewardConfig()).items() if weight}
    assert weights == {"progress": 1.0, "contact": -0.2, "step_penalty": -0.002}


def test_robot_defaults_are_the_epuck():
    robot = RobotConfig()
    assert (robot.hull_radius, robot.mass) == (epuck.HULL_RADIUS, epuck.MASS)
    assert (robot.track, robot.yaw_inertia) == (epuck.TRACK, epuck.YAW_INERTIA)


def test_independent_policies_have_one_learner_a_robot():
    assert load_train(["algo.policy=independent", "sim.max_robots=7"]).learners == 7


def test_evaluate_defaults():
    evaluate = load_levels(EvaluateConfig, ["policy=p.npz"])
    stage = load_train(["stage=s6"]).stage[0]
    assert evaluate == EvaluateConfig(policy="p.npz", stage=stage, robot=evaluate.robot)
    assert evaluate.robot.body == "wheeled"
    assert (evaluate.step_limit, evaluate.episodes, evaluate.seed) == (1500, 1000, 1)


def test_export_defaults():
    assert files.load(ExportConfig, ["run=runs/a"]) == ExportConfig(run="runs/a")


def test_configurations_are_frozen_and_hashable():
    train = load_train([])
    assert hash(train) == hash(load_train([]))
    with pytest.raises(dataclasses.FrozenInstanceError):
        train.seed = 1  # type: ignore[misc]  # the assignment is what is tested


def test_import_needs_neither_jax_nor_hydra():
    rooms = ("evaluate", "export", "replay", "report", "reproduce", "watch")
    modules = ", ".join(
        ["swarmjax.run.load_settings", *(f"swarmjax.{room}.config" for room in rooms)]
    )
    code = f"import sys, {modules}; print({{'jax', 'hydra', 'omegaconf'}} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "set()"


# Command lines that are refused, with the sentence


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        # Words and keys.
        (["arenas"], "'arenas' is not a setting: give key=value."),
        (["--arenas=3"], "'--arenas=3' is not a setting: give key=value."),
        (["+arenas=3"], "'+arenas=3' is not a setting: give key=value."),
        (["arenas", "=", "3"], "'arenas' is not a setting: give key=value without spaces."),
        (["a\nb"], "'a\\nb' is not a setting: give key=value."),
        (["hydra/launcher=x"], "'hydra/launcher=x' is not a setting: give key=value."),
        (["arena=3"], "arena is not a key: did you mean arenas?"),
        (["algo.clip_epsion=1"], "algo.clip_epsion is not a key: did you mean algo.clip_epsilon?"),
        (["task.reward.progres=1"], "task.reward.progres is not a key: did you mean "
         "task.reward.progress?"),
        (["robots=3"], "robots is not a key: did you mean stage.robots?"),
        (["name=s3"], "name is not a key: did you mean run.dir or stage.name?"),
        (["learning_rate=1"], "learning_rate is not a key: did you mean "
         "algo.actor_learning_rate?"),
        # Words of other tools.
        *(([f"{word}=1"], f"{word} is not a key: did you mean run.dir?")
          for word in ("out", "dir", "output", "folder", "logdir", "save")),
        *(([f"{word}=1"], f"{word} is not a key: did you mean budget?")
          for word in ("steps", "timesteps", "total_timesteps")),
        *(([f"{word}=1"], f"{word} is not a key: did you mean arenas?")
          for word in ("envs", "num_envs")),
        (["epochs=4"], "epochs is not a key: did you mean algo.epochs?"),
        (["gamma=1"], "gamma is not a key: did you mean algo.discount?"),
        (["n_steps=8"], "n_steps is not a key: did you mean algo.rollout_length?"),
        (["checkpoint=x"], "checkpoint is not a key: did you mean resume, init_from or "
         "run.checkpoint_minutes?"),
        *(([f"{word}=0"], f"{word} is not a key: did you mean devices or the environment variable "
           "JAX_PLATFORMS=cpu or cuda?") for word in ("device", "gpu")),
        (["stage_name=x"], "stage_name is not a key: did you mean stage?"),
        (["hydra.verbose=1"], "hydra is not a key: give one of stage, robot, task, algo, "
         "curriculum, sim, seed, seeds, seeds_by, arenas, devices, streams, budget, "
         "levels_per_rollout, realism, extensions, recipe, run, resume, init_from."),
        # Words that are not YAML, or mean something else in other tools.
        (["algo.hidden_sizes=[64"], "algo.hidden_sizes is '[64', which cannot be read: did not "
         "find expected ',' or ']', line 2, column 1."),
        (["arenas=1,2"], "arenas is '1,2': give a whole number."),
        (["budget=1M"], "budget is '1M': give a whole number, as in 1e6."),
        (["arenas=${nope}"], "arenas is '${nope}': give a whole number."),
        (["arenas=!!set {1}"], "arenas is '!!set {1}', which cannot be read: remove the YAML tag "
         "'tag:yaml.org,2002:set'."),
        # Groups.
        (["stage=s7"], f"stage is 's7': give s6 (the most similar name) or one of {CHOICES}, "
         "or the path of a .yaml file."),
        (["stage=[s1,s2]"], "stage is '[s1,s2]': give stage=curriculum "
         f"'stage.sequence=[s1,s2]' for several stages, or one of {CHOICES}, or the path of a "
         ".yaml file."),
        (["lr=1e-3"], "lr is not a key: did you mean algo.actor_learning_rate or "
         "algo.critic_learning_rate?"),
        (["stage=expand"], "stage is 'expand': give expanded (the most similar name) or one of "
         f"{CHOICES}, or the path of a .yaml file."),
        (["stage=../train"], f"stage is '../train': give one of {CHOICES}, or the path of a .yaml "
         "file."),
        (["stage=null"], f"stage is 'null': give one of {CHOICES}, or the path of a .yaml file."),
        (["robot=legged"], "robot is 'legged': give one of khepera4, paper, planar, planar_v2, "
         "thymio2, wheeled, wheeled_v2, or the path of a .yaml file."),
        # Stages and curricula.
        (["stage.side=0.9"], "stage.side cannot be given for curriculum, a curriculum: choose "
         "one stage, as in stage=s6 (in a recipe: 'stage: s6', and 'stage.side: 0.9' below it)."),
        (["stage.sequence=[s1,s9]"], "stage.sequence is 's9': give s6 (the most similar name) or "
         "one of "
         f"{CHOICES}, or the path of a .yaml file."),
        (["stage.sequence=[]"], "stage.sequence is []: give at least one stage."),
        (["stage.sequence=s1"], "stage.sequence is 's1': give a list, as in [s1,s2]."),
        (["stage.sequence=[s1,s1]"], "stage lists s1 more than once: give each stage once."),
        (["stage.sequence=[curriculum]"], "stage.sequence is curriculum, a curriculum of "
         "several stages: list single stages."),
        (["stage.sequence=[{robots: 2, side: 1}]"], "stage.name is missing and has "
         "no default: give it a value."),
        (["stage=s3", "stage.sequence=[s1]"], "stage.sequence is not a key: give one of name, "
         "robots, side, distance, obstacles, obstacle_size, level, layout, map, cell, breadth, "
         "gap, width, depth, length, radius, apart, cells."),
        (["stage=s3", "stage.name=s4"], "stage.name is 's4' in s3.yaml: give 's3'."),
        (["stage=s3", "stage.layout=fence"], "stage.layout is fence, but level is random: give "
         "level=fixed."),
        # Types and bounds.
        (["task.arrival=stay"], "task.arrival is 'stay': give latch or hold."),
        (["task=3"], "task is 3: give one of its keys, such as task.control_step."),
        (["algo.hidden_sizes=64"], "algo.hidden_sizes is 64: give a list, as in [64,64]."),
        (["algo.hidden_sizes=[]"], "algo.hidden_sizes is []: give at least one layer, as in "
        "[64,64]."),
        (["algo.hidden_sizes=[64,0]"], "algo.hidden_sizes is [64,0]: give 1 to 4096."),
        (["algo.activation=gelu"], "algo.activation is 'gelu': give tanh, relu or swish."),
        (["run.chunk=some"], "run.chunk is 'some': give a whole number or auto."),
        (["run.chunk=0"], "run.chunk is 0: give 1 to 2147483647."),
        (["run.stop_at=0"], "run.stop_at is 0: give more than 0, at most 1."),
        (["run.stop_at=95"], "run.stop_at is 95: give more than 0, at most 1."),
        (["run.dir="], "run.dir is '': give text or null."),
        (["seed=-1"], "seed is -1: give 0 to 2147483647."),
        (["robot.max_speed=0"], "robot.max_speed is 0: give 0.001 to 5."),
        (["robot.max_speed=0.3"], "robot.max_speed is 0.3, but wheels of 0.02 m at 6.28 rad/s "
         "reach only 0.1256 m/s: give at most 0.1256, or wheel_limit=clip, which limits the "
         "speed to that."),
        (["robot.hull_radius=-0.08"], "robot.hull_radius is -0.08: give more than 0, at most "
         "0.15."),
        (["curriculum.budget_share=1"], "curriculum.budget_share is 1: give more than 0, less "
         "than 1."),
        (["curriculum.threshold=1.5"], "curriculum.threshold is 1.5: give 0 to 1."),
        (["curriculum.threshold=high"], "curriculum.threshold is 'high': give a number or a list, "
         "as in [0.9,0.8]."),
        (["curriculum.threshold=[0.8,high]"], "curriculum.threshold is 'high': give a number."),
        (["stage=curriculum", "stage.sequence=[s1,s2]", "curriculum.threshold=[0.9,1.5]"],
         "curriculum.threshold is [0.9,1.5]: give 0 to 1."),
        (["stage=curriculum", "stage.sequence=[s1,s2,s3]", "curriculum.threshold=[0.9,0.8]"],
         "curriculum.threshold is [0.9,0.8], but the number of stages is 3: give one number, or "
         "one for each stage."),
        (["stage=s1", "curriculum.threshold=[]"], "curriculum.threshold is [], but the number of "
         "stages is 1: give one number, or one for each stage."),
        (["stage=s3", "curriculum.axes.robots=[2]", "curriculum.threshold=[0.9,0.8]"],
         "curriculum.threshold is [0.9,0.8], but curriculum.axes makes 2 stages: give one "
         "number."),
        (["curriculum.mode=greedy"], "curriculum.mode is 'greedy': give one of sequential, "
         "mixed, adaptive, frontier, or add extensions=FILE, the Python file that defines this "
         "curriculum."),
        (["curriculum.mode=adaptive", "curriculum.floor=0"], "curriculum.floor is 0: give more "
         "than 0, at most 1."),
        (["stage=s6", "stage.side=5"], "stage.side is 5, but level is random: give at "
         "most 4, or level=plots."),
        (["stage=s6", "stage.side=[0.8,5]"], "stage.side is [0.8,5], but level is random: "
         "give at most 4, or level=plots."),
        (["stage=s6", "stage.side=[1.2,1]"], "stage.side is [1.2,1]: give the lower number first."),
        (["stage=s6", "stage.side=[1,1.2,2]"], "stage.side is [1,1.2,2]: give a number or a range "
         "[low,high] of numbers."),
        (["stage=s2", "stage.level=fixed", "stage.side=[1,2]"], "stage.side is [1,2], but level is "
         "fixed: give one number."),
        # The smallest arena of the range must have room; 0.77 is worked out below.
        (["stage=s6", "stage.side=[0.7,1.2]"], "stage.side is [0.7,1.2], too small for robots=5, "
         "obstacles=3, obstacle_size=0.1: give at least 0.77."),
        # Options of a mode.
        (["curriculum.score=failure"], "curriculum.score is failure, but mode is mixed and does "
         "not "
         "use score: leave score at learnability, or give mode=adaptive."),
        (["curriculum.mode=mixed", "curriculum.floor=0.2"], "curriculum.floor is 0.2, but mode is "
         "mixed and does not use floor: leave floor at 0.1, or give mode=adaptive or frontier."),
        (["curriculum.mode=adaptive", "curriculum.optimizer=reset"], "curriculum.optimizer is "
         "reset, but mode is adaptive and does not use optimizer: leave optimizer at keep, or give "
         "mode=sequential or mixed."),
        (["stage.sequence=[s1,worlds]"], "stage.sequence is worlds, a curriculum of several "
         "stages: list single stages."),
        # Checks across keys.
        (["robot.track=0.08"], "robot.track is 0.08, but hull_radius is 0.037 and the wheels "
         "must lie inside the hull: give less than 0.074."),
        (["stage=s6", "stage.robots=6", "sim.max_robots=5"], "stage.robots is 6, but "
         "sim.max_robots is 5: give 1 to 5."),
        (["sim.max_obstacles=2"], "stage s6: obstacles is 3, but sim.max_obstacles is 2: give 0 "
         "to 2."),
        (["seeds=0"], "seeds is 0: give 1 to 4096."),
        (["seed=2147483647", "seeds=2"], "seed is 2147483647, but seeds is 2 and the last seed "
         "may be at most 2147483647: give a seed of at most 2147483646."),
        (["seeds_by=pmap"], "seeds_by is 'pmap': give vmap, cores or devices."),
        (["arenas=100"], "arenas is 100, but algo.num_minibatches is 8: give a multiple of 8."),
        (["budget=4095"], "budget is 4095, but one update takes arenas x algo.rollout_length = "
         "4096 control steps: give at least 4096."),
    ],
)  # fmt: skip
def test_train_refuses(words, sentence):
    assert refusal(load_train, words) == sentence


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["stage=curriculum"], "stage is curriculum, a curriculum: give one stage, as in "
         "stage=s6."),
        (["suite=all", "stage=s6"], "stage cannot be given with suite=all, which sets its own "
         "levels: leave stage or suite out."),
        (["suite=all", "seed=2"], "seed cannot be given with suite=all, which sets its own "
         "levels: leave seed or suite out."),
        (["compare=a,b"], "policy is 'p' and compare is 'a,b': give exactly one of the two, "
         "policy=FILE or compare=FILE,FILE."),
        (["policy=null"], "policy is null and compare is null: give exactly one of the two, "
         "policy=FILE or compare=FILE,FILE."),
        (["workers=0"], "workers is 0: give 1 to 1024."),
        (["engine=warp"], "engine is 'warp': give c or mjx."),
        (["algo=ppo"], "algo is not a key: give one of stage, robot, task, suite, realism, action, "
         "steps, episodes, seed, workers, substeps, extensions, policy, "
         "compare, engine, out."),
    ],
)  # fmt: skip
def test_evaluate_refuses(words, sentence):
    assert refusal(load_levels, EvaluateConfig, ["policy=p", *words]) == sentence


def test_export_refuses_an_unknown_format():
    assert refusal(files.load, ExportConfig, ["run=r", "format=pt"]) == (
        "format is 'pt': give npz, onnx, c or webots."
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "run is null and policy is null: give exactly one of the two, as in run=runs/a or "
         "policy=policy.npz."),
        (["run=r", "policy=p"], "run is 'r' and policy is 'p': give exactly one of the two, as "
         "in run=runs/a or policy=policy.npz."),
        (["policy=p", "format=c", "seed=1"], "seed is 1, but works only with run: leave seed out."),
        (["policy=p", "format=c", "step=1"], "step is 1, but works only with run: leave step out."),
        (["policy=p"], "out is null, but policy is already an npz file: give out=FILE."),
    ],
)  # fmt: skip
def test_export_refuses(words, sentence):
    assert refusal(files.load, ExportConfig, words) == sentence


def test_a_budget_of_one_update_is_enough():
    assert load_train(["budget=4096"]).updates == 1


def test_a_budget_of_most_gradient_steps_is_enough():
    """128 arenas x 32 steps an update, 8 minibatches: (2**31 - 1) // 8 updates."""
    assert load_train(["budget=1099511623680"]).updates == 268435455


def test_a_budget_of_more_gradient_steps_than_32_bits_is_refused():
    sentence = (
        "budget is 1099511627776, but gradient steps are counted in 32 bits: give a budget of at "
        "most 1099511623680, more arenas, or a longer algo.rollout_length."
    )
    assert refusal(load_train, ["budget=1099511627776"]) == sentence


def test_a_training_without_stages_is_refused():
    assert refusal(build, TrainConfig, {"stage": []}) == "stage is []: give at least one stage."


# Curricula


def test_a_side_may_be_a_range():
    (stage,) = load_train(["stage=s6", "stage.side=[0.8,1.2]"]).stage
    assert (stage.side, stage.sides) == ((0.8, 1.2), (0.8, 1.2))
    assert load_train(["stage=s6"]).stage[0].sides == (1.2, 1.2)
    made = build(TrainConfig, {"stage": [to_dict(stage)]})
    assert made.stage == (stage,)


# The room that a stage needs


def test_area_criterion_by_hand():
    # Two robots: (side - 0.10)^2 >= 2 * 2 * 0.0225 = 0.09 = 0.3^2, so side >= 0.4.
    stage = StageConfig(name="a", robots=2, side=0.5)
    # The square and its root round by 1e-16 each.
    assert smallest_side(stage) == pytest.approx(0.4, abs=1e-12)
    # 5 robots, 3 obstacles: 10 * 0.0225 + 3 * (0.141421 + 0.1)^2 = 0.225 + 3 * 0.0582843
    # = 0.3998528, whose root is 0.6323392: side >= 0.7323392.
    stage = StageConfig(name="b", robots=5, side=1.0, obstacles=3, level="fixed")
    # The sum above has seven digits.
    assert smallest_side(stage) == pytest.approx(0.7323392, abs=1e-7)
    # Random boxes fill 0.4 of the square at most: 3 * 0.0582843 / 0.4 = 0.4371323, root 0.6611598.
    stage = StageConfig(name="c", robots=5, side=1.0, obstacles=3)
    assert smallest_side(stage) == pytest.approx(0.7611598, abs=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 5), st.integers(1, 4), st.floats(0.02, 0.3))
def test_an_obstacle_leaves_a_passage_on_either_side(robots, obstacles, size):
    stage = StageConfig(name="c", robots=robots, side=4.0, obstacles=obstacles, obstacle_size=size)
    # The area implies the passages: 0.10 + sqrt((d + 0.10)^2 + more) > d + 0.20, with diagonal d.
    assert smallest_side(stage) > size * math.sqrt(2) + 2 * 0.10


def test_too_small_an_arena_names_the_least_side():
    # 0.10 + (0.1 sqrt(2) + 0.10) sqrt(3 / 0.4) = 0.761, more than 0.732 by the sum of all squares.
    data = STAGE | {"robots": 5, "obstacles": 3, "side": 0.76}
    sentence = refusal(build, TrainConfig, {"stage": [data]})
    assert sentence == (
        "stage.side is 0.76, too small for robots=5, obstacles=3, obstacle_size=0.1: "
        "give at least 0.77."
    )
    assert build(TrainConfig, {"stage": [data | {"side": 0.77}]}).stage[0].side == 0.77


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 100), st.integers(0, 20), st.floats(0.02, 0.3))
def test_every_stage_fits_the_largest_arena(robots, obstacles, size):
    stage = StageConfig(name="a", robots=robots, side=4.0, obstacles=obstacles, obstacle_size=size)
    assert smallest_side(stage) <= 4.0


@pytest.mark.parametrize("name", ["a b", "../a", "a.b"])
def test_a_stage_name_can_be_part_of_a_path(name):
    sentence = refusal(build, TrainConfig, {"stage": [STAGE | {"name": name}]})
    assert sentence == f"stage.name is '{name}': give letters, digits, _ and - only."


# Help


def test_help_lists_every_key_once():
    text = help_text(TrainConfig, "swarmjax.train", ["all"])
    listed = [line.split("=")[0].strip() for line in text.splitlines()]

    def leaves(mapping, where=""):
        for key, value in mapping.items():
            value = value[0] if key == "stage" else value
            if value and isinstance(value, dict):
                yield from leaves(value, f"{where}{key}.")
            elif f"{where}{key}" not in (
                "stage_name",
                "realism.name",
                "algo.name",
                "pieces",
                "run.id",
            ):
                yield f"{where}{key}"

    listed.remove("recipe")  # a run stores neither
    listed.remove("extensions")
    assert listed == list(leaves(to_dict(load_train([]))))


def test_help_gives_default_meaning_and_allowed_values():
    text = help_text(TrainConfig, "swarmjax.train", ["all"])
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "stage.robots=<the stage> number of robots (a whole number 1 to 1024)" in lines
    assert "arenas=128 arenas simulated at once (a whole number 1 to 1048576)" in lines
    assert (
        "run.chunk=auto updates per call of the compiled program; auto: as many as take 1 s "
        "(a whole number 1 to 2147483647 or auto)" in lines
    )
    assert (
        "sim.impl=auto physics implementation; auto: warp on an NVIDIA GPU (auto, jax or warp)"
        in lines
    )


def test_help_names_groups_and_their_choices():
    text = " ".join(help_text(TrainConfig, "swarmjax.train").split())
    assert f"stage=curriculum ({CHOICES})" in text
    assert "robot=<as trained, on wheels and with hulls of friction 1>" in help_text(
        EvaluateConfig, "swarmjax.evaluate"
    )
    assert "Groups" not in help_text(ExportConfig, "swarmjax.export")


def test_a_file_of_a_curriculum_may_have_its_name(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("name: mine\nsequence: [s1, s2]\n")
    config = load_train([f"stage={tmp_path}/mine.yaml"])
    assert (config.stage_name, config.stage_names) == ("mine", ["s1", "s2"])
    (tmp_path / "mine.yaml").write_text("name: yours\nsequence: [s1, s2]\n")
    said = refusal(load_train, [f"stage={tmp_path}/mine.yaml"])
    assert said == "stage.name is 'yours' in mine.yaml: give 'mine'."
