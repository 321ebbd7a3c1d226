"""Tests every number of the presets of robot and realism, and which settings are refused."""

import dataclasses
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sentences import refusal

from swarmjax.command import help_text
from swarmjax.config import build, to_dict
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import RobotConfig, physics_substeps
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.config import TaskConfig, resolve_encoding
from swarmjax.task.stage_files import load_levels

OFF = {item.name: None for item in dataclasses.fields(RealismConfig)}
IDEAL = OFF | {"name": "ideal", "infrared": "ideal"}
WEBOTS = IDEAL | {
    "name": "webots",
    "infrared": "webots",
    "infrared_noise": (1.0, 1.0),
    # 0.2 + 0.8 * 0.3 * (1 - 0.5 * 0.5) = 0.2 + 0.8 * 0.225 = 0.38.
    "reflectance_robot": (0.38, 0.38),
    "track": (0.057, 0.057),  # 2 * (0.026 + 0.0025)
}
REAL = {
    "name": "real",
    "infrared": "real",
    "infrared_noise": (0.5, 2.0),  # factor on the model's noise
    "infrared_gain": (0.7, 1.3),
    "infrared_yaw": 0.0349,  # 2 degrees: 2 * 3.1416 / 180 = 0.03491
    "infrared_period": (0.01, 0.05),  # 100 Hz and 20 Hz
    "reflectance": (0.35, 1.0),
    "reflectance_robot": (0.35, 1.0),
    "dead_sensor": 0.02,
    "wheel_radius": (0.0198, 0.0207),
    "track": (0.052, 0.0575),
    "max_wheel_speed": (6.0, 6.9),
    "mass": (0.13, 0.20),
    "friction": (0.6, 1.2),
    "speed_noise": 0.05,
    "speed_quantisation": "epuck2",
    "action_latency": (0, 2),
    "observation_latency": (0, 1),
    "target_distance_noise": 0.005,
    "target_bearing_noise": 0.0524,  # 3 degrees: 3 * 3.1416 / 180 = 0.05236
}
FACTORS = sorted(REAL.keys() - {"name", "infrared"})
LOADS = [load_train, lambda words: load_levels(EvaluateConfig, ["policy=p", *words])]


# Presets


@pytest.mark.parametrize("load", LOADS, ids=["train", "evaluate"])
@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        ([], IDEAL),
        (["realism=ideal"], IDEAL),
        (["realism=webots"], WEBOTS),
        (["realism=real"], REAL),
    ],
)
def test_realism_presets_are_the_tables_of_the_plan(load, words, numbers):
    assert dataclasses.asdict(load(words).realism) == numbers


@pytest.mark.parametrize("load", LOADS, ids=["train", "evaluate"])
@pytest.mark.parametrize(
    ("name", "body", "mass", "wheel_speed", "speed"),
    [
        ("planar", "planar", 0.16, 6.28, 6.28 * 0.02),
        ("wheeled", "wheeled", 0.16, 6.28, 6.28 * 0.02),
        ("planar_v2", "planar", 0.14, 7.536, 0.15072),  # 7.536 * 0.02 = 0.15072
        ("wheeled_v2", "wheeled", 0.14, 7.536, 0.15072),
    ],
)
def test_robot_presets_are_the_two_versions(load, name, body, mass, wheel_speed, speed):
    assert load([f"robot={name}"]).robot == RobotConfig(
        body=body, mass=mass, max_wheel_speed=wheel_speed, max_speed=speed
    )


def test_wheels_grip_where_they_are_unless_a_robot_says_otherwise():
    assert load_train(["robot.track=0.044"]).robot.effective_track == 0.044
    both = load_train(["robot.track=0.044", "robot.effective_track=0.05"]).robot
    assert (both.track, both.effective_track) == (0.044, 0.05)


def test_tracks_and_motor_of_the_nominal_robot():
    robot = RobotConfig()
    assert (robot.track, robot.effective_track, robot.motor_lag) == (0.052, 0.052, 0.0)
    assert load_train(["robot.effective_track=0.057"]).robot == dataclasses.replace(
        robot, effective_track=0.057
    )


@pytest.mark.parametrize("factor", FACTORS)
def test_each_factor_is_switched_off_alone(factor):
    real = load_train(["realism=real", f"realism.{factor}=null"]).realism
    assert dataclasses.asdict(real) == REAL | {factor: None}


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("mass=[0.13,0.2]", (0.13, 0.2)),
        ("mass=[1,2]", (1.0, 2.0)),
        ("action_latency=[1,1]", (1, 1)),
        ("speed_quantisation=epuck1", "epuck1"),
        ("dead_sensor=0.5", 0.5),
        ("infrared=real", "real"),
    ],
)
def test_each_factor_is_switched_on_alone(word, value):
    made = getattr(load_train([f"realism.{word}"]).realism, word.partition("=")[0])
    assert (made, repr(made)) == (value, repr(value))


def test_ranges_replace_those_of_the_preset():
    real = load_train(["realism.friction=[0.9,1]", "realism=real"]).realism
    assert dataclasses.asdict(real) == REAL | {"friction": (0.9, 1.0)}


def test_round_trip_keeps_ranges():
    train = load_train(["realism=real", "robot=wheeled_v2", "task.encoding=webots"])
    assert build(TrainConfig, json.loads(json.dumps(to_dict(train)))) == train
    assert to_dict(train)["realism"]["mass"] == [0.13, 0.20]


@settings(max_examples=30, deadline=None)
@given(st.floats(0.011, 1.0), st.floats(0.011, 1.0))
def test_a_range_has_its_lower_number_first(first, second):
    if first <= second:
        assert build(RealismConfig, {"mass": [first, second]}).mass == (first, second)
    else:
        sentence = refusal(build, RealismConfig, {"mass": [first, second]}, "realism.")
        assert sentence.startswith("realism.mass is [")
        assert sentence.endswith("]: give the lower number first.")


# What follows from them


@pytest.mark.parametrize(
    ("body", "given", "count"),
    [
        ("planar", None, 1),
        ("wheeled", None, 2),
        ("planar", 3, 3),
        ("wheeled", 1, 1),
    ],
)
def test_substeps_are_those_given_or_those_of_the_body(body, given, count):
    assert physics_substeps(RobotConfig(body=body), given) == count


def test_substeps_are_not_given_by_default():
    assert load_train([]).sim.substeps is None
    assert load_levels(EvaluateConfig, ["policy=p"]).substeps is None


@pytest.mark.parametrize(
    ("encoding", "infrared", "resolved"),
    [
        ("auto", "ideal", "metric"),
        ("auto", "real", "metric"),
        ("auto", "webots", "webots"),
        ("metric", "webots", "metric"),
        ("webots", "ideal", "webots"),
    ],
)
def test_encoding_follows_the_sensors_unless_given(encoding, infrared, resolved):
    task, realism = TaskConfig(encoding=encoding), RealismConfig(infrared=infrared)
    assert resolve_encoding(task, realism) == resolved


# Refusals


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        # Ranges.
        (["realism.mass=0.2"], "realism.mass is 0.2: give a range [low,high] of numbers or null."),
        (["realism.mass=[0.2]"], "realism.mass is [0.2]: give a range [low,high] of numbers or "
         "null."),
        (["realism.mass=[0.1,0.2,0.3]"], "realism.mass is [0.1,0.2,0.3]: give a range [low,high] "
         "of numbers or null."),
        (["realism.mass=[a,b]"], "realism.mass is ['a','b']: give a range [low,high] of numbers "
         "or null."),
        (["realism.mass=[null,0.2]"], "realism.mass is [null,0.2]: give a range [low,high] of "
         "numbers or null."),
        (["realism.action_latency=[0,1.5]"], "realism.action_latency is [0,1.5]: give a range "
         "[low,high] of whole numbers or null."),
        (["realism.mass=[0.2,0.13]"], "realism.mass is [0.2,0.13]: give the lower number first."),
        # Words.
        (["realism=null"], "realism is 'null': give one of ideal, real, webots, or the path of "
         "a .yaml file."),
        (["realism=reel"], "realism is 'reel': give real (the most similar name) or one of "
         "ideal, real, webots, or the path of a .yaml file."),
        (["realism.name=real"], "realism.name cannot be set by itself: choose a file, as in "
         "realism=webots."),
        (["realism.infrared=counts"], "realism.infrared is 'counts': give ideal, webots or real."),
        (["realism.speed_quantisation=epuck"], "realism.speed_quantisation is 'epuck': give "
         "epuck1, epuck2 or null."),
        (["task.encoding=counts"], "task.encoding is 'counts': give auto, metric or webots."),
        (["realism.infrared_gian=[1,1]"], "realism.infrared_gian is not a key: did you mean "
         "realism.infrared_gain?"),
        (["dead_sensor=0"], "dead_sensor is not a key: did you mean realism.dead_sensor?"),
        # Sensors that have no counts.
        (["realism.infrared_gain=[0.7,1.3]"], "realism.infrared_gain is [0.7,1.3], but infrared "
         "is ideal and has no sensor counts: give null for infrared_gain, or give "
         "infrared=webots or real."),
        (["realism=webots", "realism.infrared=ideal"], "realism.infrared_noise is [1,1], but "
         "infrared is ideal and has no sensor counts: give null for infrared_noise, or "
         "give infrared=webots or real."),
        # Impossible bodies.
        (["robot.mass=-1"], "robot.mass is -1: give more than 0, at most 100."),
        (["robot.mass=0.01"], "robot.mass is 0.01, but wheel_mass is 0.005 and mass includes "
         "both wheels: give more than 0.01."),
        (["realism.mass=[-0.1,0.2]"], "realism.mass is [-0.1,0.2]: give more than 0.01, at most "
         "100."),
        (["robot.effective_track=0.074"], "robot.effective_track is 0.074, but hull_radius is "
         "0.037 and the wheels must lie inside the hull: give less than 0.074."),
        (["robot.wheel_radius=0.04"], "robot.wheel_radius is 0.04, but hull_radius is 0.037 and "
         "the wheels must lie inside the hull: give less than 0.037."),
        (["realism.track=[0.052,0.08]"], "realism.track is [0.052,0.08], but robot.hull_radius "
         "is 0.037 and the wheels must lie inside the hull: give less than 0.074."),
        (["realism.wheel_radius=[0.02,0.03]"], "realism.wheel_radius is [0.02,0.03]: give "
         "0.001 or more, less than 0.03."),
        (["robot.hull_radius=0.029", "robot.sensor_poses=[[0.02,0,0]]",
          "realism.wheel_radius=[0.02,0.0295]"], (
              "realism.wheel_radius is [0.02,0.0295], but robot.hull_radius is 0.029 and the "
              "wheels must lie inside the hull: give less than 0.029."
          )),
        # The wheels have 2 * (5.1e-7 + 0.005 * 0.026^2) = 2 * (5.1e-7 + 3.38e-6) = 7.78e-6.
        (["robot=wheeled", "robot.yaw_inertia=7e-6"], "robot.yaw_inertia is 7e-06, but body is "
         "wheeled, and the wheels alone have 7.78e-06: give more than 7.78e-06."),
        (["robot.motor_lag=-0.1"], "robot.motor_lag is -0.1: give 0 to 1."),
        # Impossible draws.
        (["realism.friction=[0,1]"], "realism.friction is [0,1]: give 0.001 to 10."),
        (["realism.max_wheel_speed=[0,6]"], "realism.max_wheel_speed is [0,6]: give 0.001 "
         "to 1000."),
        (["realism.speed_noise=-0.05"], "realism.speed_noise is -0.05: give 0 to 1."),
        (["realism.dead_sensor=1.1"], "realism.dead_sensor is 1.1: give 0 to 1."),
        (["realism.target_distance_noise=-1"], "realism.target_distance_noise is -1: give 0 to "
         "10."),
        (["realism=real", "realism.reflectance=[0,1]"], "realism.reflectance is [0,1]: give more "
         "than 0, at most 1."),
        # Times longer than the episode, whose 500 control steps of 0.032 s are 16 s.
        (["realism.action_latency=[0,500]"], "realism.action_latency is [0,500], but an episode "
         "takes 500 control steps: give less than 500."),
        (["realism.observation_latency=[0,600]"], "realism.observation_latency is [0,600], but "
         "an episode takes 500 control steps: give less than 500."),
        (["realism.action_latency=[-1,2]"], "realism.action_latency is [-1,2]: give 0 to "
         "1000."),
        (["realism.infrared_period=[0.01,16]"], "realism.infrared_period is [0.01,16], but an "
         "episode takes 16 s: give less than 16."),
    ],
)  # fmt: skip
def test_train_refuses(words, sentence):
    assert refusal(load_train, words) == sentence


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["steps=2", "realism=real"], "realism.action_latency is [0,2], but an episode takes 2 "
         "control steps: give less than 2."),
        # 1500 * 0.032 = 48 s.
        (["realism.infrared_period=[1,48]"], "realism.infrared_period is [1,48], but an episode "
         "takes 48 s: give less than 48."),
        (["realism.track=[0.05,0.09]"], "realism.track is [0.05,0.09], but robot.hull_radius is "
         "0.037 and the wheels must lie inside the hull: give less than 0.074."),
        (["realism.name=real"], "realism.name cannot be set by itself: choose a file, as in "
         "realism=webots."),
    ],
)  # fmt: skip
def test_evaluate_refuses(words, sentence):
    assert refusal(load_levels, EvaluateConfig, ["policy=p", *words]) == sentence


@pytest.mark.parametrize("factor", FACTORS)
def test_metres_know_neither_noise_nor_gain_nor_reflectance(factor):
    counted = {"infrared_noise", "infrared_gain", "reflectance", "reflectance_robot"}
    realism = {factor: REAL[factor]}
    if factor in counted:
        sentence = refusal(build, RealismConfig, realism)
        assert sentence.startswith(f"{factor} is ")
        assert ", but infrared is ideal and has no sensor counts" in sentence
    else:
        assert getattr(build(RealismConfig, realism), factor) == REAL[factor]


@pytest.mark.parametrize("factor", sorted(set(FACTORS) - {"speed_quantisation"}))
def test_no_factor_is_negative(factor):
    value = [-1, 0] if isinstance(REAL[factor], tuple) else -1
    sentence = refusal(build, RealismConfig, {"infrared": "real", factor: value}, "realism.")
    assert sentence.startswith(f"realism.{factor} is {'[-1,0]' if value != -1 else -1}: give ")


def test_the_inertia_of_wheels_bounds_the_wheeled_body_only():
    assert RobotConfig(yaw_inertia=7e-6).body == "planar"
    assert RobotConfig(body="wheeled", yaw_inertia=8e-6).yaw_inertia == 8e-6


def test_a_range_begins_with_the_lower_number():
    assert refusal(build, RealismConfig, {"track": [0.06, 0.05]}) == (
        "track is [0.06,0.05]: give the lower number first."
    )


# Help


@pytest.mark.parametrize(
    ("cls", "command", "robot", "realism", "mass"),
    [
        (TrainConfig, "train", "planar", "ideal", "null"),
        (
            EvaluateConfig,
            "evaluate",
            "<as trained, on wheels and with hulls of friction 1>",
            "<as trained>",
            "<as trained>",
        ),
    ],
)
def test_help_gives_range_unit_and_choices(cls, command, robot, realism, mass):
    overview = " ".join(help_text(cls, command).split())
    assert f"realism={realism} (ideal, real, webots)" in overview
    assert (
        f"robot={robot} (khepera4, paper, planar, planar_v2, thymio2, wheeled, wheeled_v2)"
        in overview
    )
    lines = [" ".join(line.split()) for line in help_text(cls, command, ["realism"]).splitlines()]
    assert (
        f"realism.mass={mass} mass, kg; drawn per robot and episode "
        "(a range [low,high] of numbers more than 0.01, at most 100 or null)" in lines
    )
    assert (
        f"realism.action_latency={mass} latency of commands, control steps; drawn per robot and "
        "episode (a range [low,high] of whole numbers 0 to 1000 or null)" in lines
    )
    assert not any(line.startswith("realism.name") for line in lines)
