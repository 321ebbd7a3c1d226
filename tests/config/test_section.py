"""Tests the strict converter, and sections that a test constructs directly."""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sentences import refusal

from swarmjax.config import ConfigError, Section, about, build, files, to_dict
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.export.config import ExportConfig
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import RunConfig, TrainConfig
from swarmjax.sim.config import SimConfig
from swarmjax.task.config import RewardConfig
from swarmjax.task.stage_config import StageConfig, smallest_side
from swarmjax.task.stage_files import load_levels
from swarmjax.watch.config import WatchConfig

STAGE = {"name": "s", "robots": 2, "side": 1.0}
TWO = ["stage=curriculum", "stage.sequence=[s1,s2]"]


# Round trip


@pytest.mark.parametrize(
    ("load", "words"),
    [
        (load_train, []),
        (load_train, ["stage=s3", "algo.hidden_sizes=[8,16,32]", "run.chunk=9", "run.dir=a b"]),
        (load_train, [*TWO, "curriculum.threshold=[0.9,1]"]),
        (load_train, ["stage.sequence=[s2,s1]", "sim.substeps=4", "run.chunk=7"]),
        (partial(load_levels, EvaluateConfig), ["policy=p", "stage=expanded", "workers=2"]),
        (partial(files.load, ExportConfig), ["run=r", "step=3"]),
    ],
)
def test_round_trip_through_json(load, words):
    made = load(words)
    assert build(type(made), json.loads(json.dumps(to_dict(made)))) == made


@settings(max_examples=30, deadline=None)
@given(
    robots=st.integers(1, 5),
    obstacles=st.integers(0, 4),
    size=st.floats(0.02, 0.3),
    extra=st.floats(0.0, 0.5),
    rollout=st.integers(1, 64),
    factor=st.integers(1, 16),
    spare=st.integers(0, 1000),
)
def test_round_trip_of_any_sound_configuration(
    robots, obstacles, size, extra, rollout, factor, spare
):
    probe = StageConfig(name="p", robots=robots, side=4.0, obstacles=obstacles, obstacle_size=size)
    side = max(0.4, smallest_side(probe) + extra)
    data = {
        "stage": [dataclasses.asdict(probe) | {"side": side}],
        "algo": {"rollout_length": rollout},
        "arenas": 8 * factor,
        "budget": 8 * factor * rollout + spare,
    }
    train = build(TrainConfig, data)
    assert build(TrainConfig, json.loads(json.dumps(to_dict(train)))) == train
    update = 8 * factor * rollout
    assert train.updates * update <= train.budget < (train.updates + 1) * update


# The converter


@pytest.mark.parametrize("value", [4096, 4096.0])
def test_whole_numbers_become_integers(value):
    budget = build(TrainConfig, {"stage": [STAGE], "budget": value}).budget
    assert (budget, type(budget)) == (4096, int)


def test_hydra_reads_an_exponent_as_a_float_and_we_as_an_integer():
    budget = load_train(["budget=1e6"]).budget
    assert (budget, type(budget)) == (1_000_000, int)


def test_integers_become_floats():
    progress = build(RewardConfig, {"progress": 1}).progress
    assert (progress, type(progress)) == (1.0, float)


def test_a_long_integer_keeps_every_digit():
    # 2**53 + 1 is the first integer that a float cannot hold.
    with pytest.raises(ConfigError, match="9007199254740993"):
        build(TrainConfig, {"stage": [STAGE], "seed": 9007199254740993})


@pytest.mark.parametrize(
    "value", [True, None, "many", "4096", "", 1.5, math.nan, math.inf, "nan", "inf", [8], {"a": 1}]
)
def test_what_is_no_whole_number_is_refused(value):
    sentence = refusal(build, TrainConfig, {"stage": [STAGE], "arenas": value})
    assert sentence.startswith("arenas is ")
    assert sentence.endswith(": give a whole number.")


def test_a_whole_number_of_any_length_is_one_and_held_to_the_bounds():
    sentence = refusal(build, TrainConfig, {"stage": [STAGE], "arenas": 10**400})
    # The sentence shortens the number to 77 characters and an ellipsis.
    assert sentence == f"arenas is 1{'0' * 76}...: give 1 to 1048576."


@pytest.mark.parametrize("value", [True, None, "fast", math.nan, -math.inf, "nan", [1.0]])
def test_what_is_no_number_is_refused(value):
    sentence = refusal(build, RewardConfig, {"progress": value}, "task.reward.")
    assert sentence.startswith("task.reward.progress is ")
    assert sentence.endswith(": give a number.")
    # An integer too large for a float is refused like a value that is no number.
    assert refusal(build, RewardConfig, {"progress": 10**400}).endswith(": give a number.")


@pytest.mark.parametrize("value", [1, 0, "true", None])
def test_only_true_and_false_are_booleans(value):
    assert refusal(build, RunConfig, {"episodes": value}, "run.").endswith("give true or false.")


def test_null_only_where_it_is_allowed():
    assert build(SimConfig, {"substeps": None}).substeps is None
    assert refusal(build, RewardConfig, {"progress": None}, "task.reward.") == (
        "task.reward.progress is null: give a number."
    )


@pytest.mark.parametrize(("value", "made"), [("auto", "auto"), (3.0, 3)])
def test_chunk_takes_a_number_or_a_word(value, made):
    assert build(RunConfig, {"chunk": value}).chunk == made


def test_lists_become_tuples():
    train = build(TrainConfig, {"stage": [STAGE], "algo": {"hidden_sizes": [8, 16.0]}})
    assert train.algo.hidden_sizes == (8, 16)
    assert isinstance(train.stage, tuple)


def test_a_threshold_is_a_number_or_a_list_of_numbers():
    assert load_train([*TWO, "curriculum.threshold=1"]).curriculum.threshold == 1.0
    made = load_train([*TWO, "curriculum.threshold=[0.9,1]"]).curriculum.threshold
    assert repr(made) == "(0.9, 1.0)"


def test_stages_of_a_curriculum_are_named_in_sentences():
    good, bad = STAGE, STAGE | {"name": "t", "robots": 0}
    assert refusal(build, TrainConfig, {"stage": [good, bad]}) == (
        "stage t: robots is 0: give 1 to 1024."
    )
    assert refusal(build, TrainConfig, {"stage": [bad]}) == "stage.robots is 0: give 1 to 1024."
    assert refusal(build, TrainConfig, {"stage": [good, 3]}) == (
        "stage 1 is 3: give one of its keys, such as stage 1: name."
    )


def test_a_missing_key_is_named():
    said = "run is missing and has no default: give it a value."
    assert refusal(files.load, WatchConfig, []) == said
    assert refusal(build, TrainConfig, {"stage": [{"name": "s", "side": 1.0}]}) == (
        "stage.robots is missing and has no default: give it a value."
    )


def test_sections_made_by_hand_are_held_to_their_bounds():
    assert refusal(lambda: SimConfig(max_robots=0)) == "max_robots is 0: give 1 to 1024."
    assert refusal(lambda: RewardConfig(step_penalty=math.nan)) == (
        "step_penalty is nan: give -1000000 to 1000000."
    )


@dataclass(frozen=True, kw_only=True)
class _Limited(Section):
    number: int = field(default=1, metadata=about("a number", 1, 5, reason="there are five"))


def test_a_bound_gives_its_reason_to_who_exceeds_it():
    assert refusal(lambda: _Limited(number=6)) == "number is 6: give 1 to 5; there are five."


def test_a_bound_keeps_its_reason_from_who_gives_too_little():
    assert refusal(lambda: _Limited(number=0)) == "number is 0: give 1 to 5."


def test_the_largest_hull_has_a_reason():
    sentence = refusal(load_train, ["robot.hull_radius=0.2"])
    assert sentence == (
        "robot.hull_radius is 0.2: give more than 0, at most 0.15; passages are 2.7 hull radii "
        "wide, and an arena of 4 m would hold few of them."
    )
