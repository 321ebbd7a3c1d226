"""Tests what is refused about the sensors of a robot of one's own."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from policies import saved
from sentences import refusal

from swarmjax.evaluate import judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.policy import PolicyError
from swarmjax.run.load_settings import load_train
from swarmjax.sim import model, response
from swarmjax.sim.config import RobotConfig
from swarmjax.task import observation, room
from swarmjax.task.level import Spacing
from swarmjax.task.stage_config import StageConfig

ONE = "[[0.03,0,0]]"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["robot.sensor_poses=[[0.04,0,0]]"], "robot.sensor_poses puts sensor 0 at [0.04,0,0], "
         "0.040000 m from the middle, but hull_radius is 0.037: move the sensor to at most "
         "0.037 m (round x and y towards 0), or give a larger hull."),
        (["robot.hull_radius=0.03"], "robot.sensor_poses puts sensor 0 at "
         "[0.03,-0.01,-0.30081], 0.031623 m from the middle, but hull_radius is 0.03: move the "
         "sensor to at most 0.03 m (round x and y towards 0), or give a larger hull."),
        (["robot.sensor_poses=[[0.03,0,3.14159]]"], "robot.sensor_range is 0.04, but the ray of "
         "sensor 0, [0.03,0,3.14159], runs 0.067 m within its own hull and would see nothing: "
         "give a larger range, or turn or move the sensor outwards."),
        (["robot.sensor_range=0"], "robot.sensor_range is 0: give more than 0, at most 1."),
        (["robot.sensor_height=0.05"], "robot.sensor_height is 0.05: give more than 0.0025, less "
         "than 0.0475."),
        (["robot.sensor_poses=[[0.03,0,40]]"], "robot.sensor_poses holds [0.03,0,40] for sensor "
         "0, whose last number is its yaw in radians: give a yaw of -6.2832 to 6.2832."),
        (["robot.sensor_poses=[]"], "robot.sensor_poses has 0 sensors: give 1 to 32."),
        (["robot.sensor_poses=[[0.03,0]]"], "robot.sensor_poses is [0.03,0]: give 3 numbers."),
        (["robot.sensor_poses=3"], "robot.sensor_poses is 3: give a list, as in "
         "[[0.03,-0.01,-0.3],[0.03,0.01,0.3]]."),
        (["robot.sensor_response=[[0,9,0],[0.1,9,0]]"], "robot.sensor_response is "
         "[[0,9,0],[0.1,9,0]]: give two or more rows [distance, value, relative deviation], with "
         "rising distances and falling values."),
        ([f"robot.sensor_poses={ONE}", "realism=real"], "realism.infrared is real, which uses "
         "the measured sensors of the e-puck, but robot.sensor_poses has other sensors: give "
         "realism.infrared=webots with robot.sensor_response, or realism.infrared=ideal."),
    ],
)  # fmt: skip
def test_impossible_sensors_are_refused(words: list[str], sentence: str) -> None:
    assert refusal(load_train, words) == sentence


def test_the_ends_are_accepted() -> None:
    two = ((0.037, 0.0, 0.0),) * 2  # on the surface, and alike
    assert RobotConfig(sensor_poses=two).sensor_poses == two
    many = ((0.03, 0.0, 0.0),) * 32
    assert len(RobotConfig(sensor_poses=many).sensor_poses) == 32


def test_a_policy_is_refused_on_a_robot_with_other_sensors(tmp_path: Path) -> None:
    trained = saved(tmp_path / "p.npz")
    robot = RobotConfig(sensor_poses=((0.03, 0.0, 0.0),))
    config = EvaluateConfig(
        policy="p.npz", stage=StageConfig(name="one", robots=1, side=1.0), robot=robot
    )
    with pytest.raises(PolicyError) as caught:
        judge.check_policy(config, config.stage, "p.npz", trained)
    assert str(caught.value).startswith("p.npz was trained with other sensors: the policy's meta")


def test_the_observation_has_an_entry_for_each_sensor() -> None:
    names = observation.layout("metric", sensors=3).names
    assert names == ("infrared_0", "infrared_1", "infrared_2", "target_distance", "target_bearing")
    assert observation.layout("metric").names == observation.NAMES


@pytest.mark.parametrize("name", ["khepera4", "thymio2"])
def test_another_robot_has_its_mass_its_inertia_and_readings(name: str) -> None:
    robot = load_train([f"robot={name}", "robot.body=wheeled"]).robot
    built = model.build(robot, model.ArenaSize(1, 0, 0.05), 0.016, ray_geoms=True).compile()
    assert built.body_mass.sum() == pytest.approx(robot.mass, rel=1e-12)
    data = mujoco.MjData(built)
    full = np.zeros((built.nv, built.nv))
    mujoco.mj_forward(built, data)
    mujoco.mj_fullM(built, data, full)
    assert full[5, 5] == pytest.approx(robot.yaw_inertia, rel=1e-9)  # the sixth axis is yaw
    table = response.table(robot.sensor_response, robot.sensor_tilt)
    for length, value, _ in robot.sensor_response:
        ray = np.array([length])
        assert response.expected("webots", ray, np, table)[0] == pytest.approx(value)
        back = response.distance("webots", np.array([float(value)]), np, table)[0]
        assert back == pytest.approx(length, abs=1e-9)


@pytest.mark.parametrize(("hull", "side"), [(0.07, 1.5), (0.15, 3.2)])
def test_levels_hold_larger_robots(hull: float, side: float) -> None:
    stage = StageConfig(name="wide", robots=4, obstacles=2, side=side)
    spacing = Spacing(4, 2, hull, 0.05)
    room.check([stage], spacing)  # draws levels, and refuses a robot that touches anything
    own = dataclasses.replace(stage, side=1.0)
    least = refusal(room.check, [own], spacing).rsplit(" ", 1)[1]
    assert 1.0 < float(least.rstrip(".")) <= side
