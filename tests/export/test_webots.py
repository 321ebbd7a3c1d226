"""Tests the Webots controller, run as Webots runs it, with a stand-in for Webots' package."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import policies
import pytest
from entries import by_name
from policies import saved, several

from swarmjax import epuck, policy
from swarmjax.export import __main__ as export
from swarmjax.export import webots_controller
from swarmjax.policy import Policy
from swarmjax.sim import drive, response
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import electronics as task_electronics
from swarmjax.task import factors, observation
from swarmjax.task.config import TaskConfig

NAMES = webots_controller.QUANTITIES  # measured by the controller, observed by these policies
METRIC, WEBOTS = policies.observed("metric", NAMES), policies.observed("webots", NAMES)

# A stand-in for Webots' package, written from the manual's names and units. It plays a script,
# {"basic": ms, "custom": text, "missing": [names], "steps": [{"counts": [8], "gps": [3],
# "compass": [3], "custom": text}, ..]}, and records the commands to the motors.
STAND_IN = """
import json, math, pathlib

_SCRIPT = json.loads(pathlib.Path("script.json").read_text())
_now = {"step": -1}
_told = []


class _Sensor:
    def __init__(self, name):
        self._name, self._period = name, 0

    def enable(self, period):
        assert isinstance(period, int) and period > 0
        self._period = period

    def _read(self, key):
        # Not enabled, or enabled and not stepped yet, a sensor of Webots has no value.
        if not self._period or _now["step"] < 0:
            return math.nan
        return _SCRIPT["steps"][_now["step"]][key]


class _DistanceSensor(_Sensor):
    def getValue(self):
        counts = self._read("counts")
        return counts if isinstance(counts, float) else counts[int(self._name[2:])]


class _Vector(_Sensor):
    def getValues(self):
        return self._read(self._name)


class _Motor:
    def __init__(self, name):
        self._side = {"left wheel motor": 0, "right wheel motor": 1}[name]
        self._free = False

    def setPosition(self, position):
        self._free = position == math.inf

    def setVelocity(self, speed):
        assert self._free, "without setPosition(inf) a motor of Webots turns to a position"
        assert type(speed) is float
        _told.append([_now["step"], self._side, speed])


class Robot:
    def getBasicTimeStep(self):
        return _SCRIPT["basic"]

    def getCustomData(self):
        return _SCRIPT["steps"][max(_now["step"], 0)].get("custom", "")

    def getDevice(self, name):
        if name in _SCRIPT["missing"]:
            return None
        kind = _DistanceSensor if name[:2] == "ps" else _Motor if "motor" in name else _Vector
        return kind(name)

    def step(self, period):
        assert period % _SCRIPT["basic"] == 0
        _now["step"] += 1
        if _now["step"] < len(_SCRIPT["steps"]):
            return 0
        pathlib.Path("told.json").write_text(json.dumps(_told))
        return -1
"""


def _exported(tmp_path: Path, *words: str, **changes: Any) -> tuple[Policy, Path]:
    """Writes a policy and exports it."""
    changes = {"observation": METRIC} | changes
    learners = changes.get("learners", 1)
    given = policies.arrays(hidden=(16, 16), learners=learners, names=NAMES)
    if changes["observation"]["encoding"] == "webots":
        given["normalizer/mean"][:] = by_name(NAMES, 0.3, distance=0.5, bearing=0.5, other=0.0)
        given["normalizer/std"][:] = by_name(NAMES, 0.3, distance=0.3, bearing=0.25, other=1.0)
    trained = saved(tmp_path / "policy.npz", given, **changes)
    assert export.main([f"policy={tmp_path / 'policy.npz'}", "format=webots", *words]) == 0
    return trained, tmp_path / "swarmjax_epuck"


def _simulate(
    folder: Path, steps: list[dict[str, Any]], *words: str, basic: float = 32.0, **script: Any
) -> subprocess.CompletedProcess[str]:
    """Runs the controller in its folder, as Webots does, with only the stand-in on PYTHONPATH."""
    beside = folder.parent / "webots"
    beside.mkdir(exist_ok=True)
    (beside / "controller.py").write_text(STAND_IN)
    played = {"basic": basic, "missing": [], "steps": steps, **script}
    (folder / "script.json").write_text(json.dumps(played))
    return subprocess.run(
        [sys.executable, f"{folder.name}.py", *words],
        cwd=folder,
        env={"PYTHONPATH": str(beside)},
        capture_output=True,
        text=True,
        check=False,
    )


def _told(folder: Path, steps: int) -> np.ndarray:
    """Returns the commanded wheel speeds [steps, 2]; checks that each step has one per wheel."""
    told = [row for row in json.loads((folder / "told.json").read_text()) if row[0] >= 0]
    assert [row[:2] for row in told] == [[i, side] for i in range(steps) for side in (0, 1)]
    return np.array([row[2] for row in told]).reshape(steps, 2)


class Scene(NamedTuple):
    """A robot's pose, and the lengths of its sensors' rays at this pose."""

    pose: np.ndarray  # [3] x, y (m), yaw (rad)
    ray: np.ndarray  # [K] m


def _scene(draw: np.random.Generator) -> Scene:
    pose = draw.uniform([-1, -1, -4], [1, 1, 4]).astype(np.float32)
    return Scene(pose, draw.uniform(0, 0.11, 8).astype(np.float32))


def _script(scene: Scene) -> dict[str, Any]:
    """Returns the readings of a robot's devices in a scene."""
    x, y, yaw = scene.pose.tolist()
    return {
        "counts": response.expected("webots", scene.ray, np).tolist(),
        "gps": [x, y, 0.05],
        # North is the world's y; a compass reports it in the robot's own frame.
        "compass": [math.sin(yaw), math.cos(yaw), 0.0],
    }


def _chain(trained: Policy, scenes: list[Scene], target: tuple[float, float]) -> np.ndarray:
    """Returns the wheel speeds [T, R, 2] of `evaluate` in the scenes, with Webots' sensors."""
    pose, ray = (np.array(part)[:, None] for part in zip(*scenes, strict=True))
    realism = RealismConfig(infrared="webots")
    electronics = task_electronics.load(TaskConfig(), realism, encoding=trained.encoding)
    distance, bearing = observation.to_target(pose, np.array([target], np.float32), np)
    sight = task_electronics.Sight(ray, None, distance, bearing)
    none = factors.Factors(**dict.fromkeys(factors.Factors._fields))
    _, seen = task_electronics.begin(electronics, none, sight, np.zeros(len(scenes)), np)
    known = [observation.NAMES.index(name) for name in NAMES]
    robots = np.repeat(seen[..., known], len(trained.mean), axis=1)
    robot = drive.from_config(RobotConfig())
    command = drive.command(policy.act(trained, robots), robot, np)
    return drive.wheel_speeds(command, robot, np)


@pytest.mark.parametrize("layout", [METRIC, WEBOTS], ids=["metric", "webots"])
@pytest.mark.parametrize("learners", [1, 3])
def test_the_wheels_turn_as_they_do_in_the_judge(
    learners: int, layout: dict[str, Any], tmp_path: Path
) -> None:
    trained, folder = _exported(tmp_path, observation=layout, **several(learners))
    draw = np.random.default_rng(learners)
    scenes = [_scene(draw) for _ in range(40)]
    target = (1.5, -0.4)  # out of reach of all poses
    words = ("action=mean", "target=1.5,-0.4", *([] if learners == 1 else ["robot=2"]))
    done = _simulate(folder, [_script(scene) for scene in scenes], *words)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    found = _told(folder, len(scenes))
    expected = _chain(trained, scenes, target)[:, -1]
    assert np.ptp(expected, axis=0).min() > 1.0  # rad/s; the readings change the speeds.
    assert (np.abs(expected) == np.float32(epuck.MAX_WHEEL_SPEED)).any()  # Some are clamped.
    # The controller computes rays and the target's bearing in float64, and the judge computes them
    # in float32. They differ by 2**-23 of 4 rad, or by 1e-7 m where the normaliser's deviation is
    # 6e-3 m. That is 2e-5 of a policy's input. A network with gains near 1 passes it on, times
    # about 6 rad/s.
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_robot_draws_its_actions_from_the_policy(tmp_path: Path) -> None:
    given = policies.arrays(hidden=(16, 16), names=NAMES)
    given["actor/log_std"][:] = np.log([0.1, 0.02])  # too small to reach a limit of the command
    given["actor/mean/kernel"][:] = 0.0
    given["actor/mean/bias"][:] = 0.0
    trained = saved(tmp_path / "policy.npz", given, observation=METRIC)
    assert export.main([f"policy={tmp_path / 'policy.npz'}", "format=webots"]) == 0
    folder = tmp_path / "swarmjax_epuck"
    steps = [_script(_scene(np.random.default_rng(0)))] * 2000
    assert _simulate(folder, steps, "target=1.5,-0.4").returncode == 0
    left, right = _told(folder, len(steps)).T
    body = trained.meta["robot"]
    speed = 0.5 * (left + right) * body["wheel_radius"]
    turn = (right - left) * body["wheel_radius"] / body["track"]
    # An action of 0 is half the speed and no turn. A deviation measured on 2,000 draws has a
    # standard error of 1 / sqrt(4000) = 1.6 %. A mean has a standard error of the deviation divided
    # by sqrt(2000). The tolerances are five times these errors.
    for found, mean, deviation in (
        (speed, 0.5 * trained.max_speed, 0.1 * 0.5 * trained.max_speed),
        (turn, 0.0, 0.02 * trained.max_turn_rate),
    ):
        np.testing.assert_allclose(np.std(found), deviation, rtol=0.08)
        np.testing.assert_allclose(np.mean(found), mean, atol=0.11 * deviation)
    assert abs(np.corrcoef(speed, turn)[0, 1]) < 0.11


def test_a_robot_stays_where_it_has_arrived_until_its_target_moves(tmp_path: Path) -> None:
    _, folder = _exported(tmp_path)
    north = {"counts": [67.19] * 8, "compass": [0.0, 1.0, 0.0]}
    at = [0.2, 0.11, 0.051, 0.049, 0.06, 0.06, 0.06]  # m from the target, along x
    goals = ["target=0,0"] * 5 + ["target=-2,0", ""]
    steps = [
        north | {"gps": [-x, 0.0, 0.0], "custom": goal} for x, goal in zip(at, goals, strict=True)
    ]
    done = _simulate(folder, steps)
    assert (done.returncode, done.stderr) == (0, "")
    moving = np.abs(_told(folder, len(steps))).max(axis=1) > 0
    # The robot stops below 0.05 m and stays. Then it gets another target, and then no target.
    assert moving.tolist() == [True, True, True, False, False, True, False]


def test_a_robot_that_holds_drives_on_at_its_target(tmp_path: Path) -> None:
    task = policies.meta()["task"] | {"arrival": "hold"}
    _, folder = _exported(tmp_path, task=task)
    north = {"counts": [67.19] * 8, "compass": [0.0, 1.0, 0.0], "custom": "target=0,0"}
    steps = [north | {"gps": [-x, 0.0, 0.0]} for x in (0.051, 0.049, 0.01, 0.06)]
    done = _simulate(folder, steps, "action=mean")
    assert (done.returncode, done.stderr) == (0, "")
    assert (np.abs(_told(folder, len(steps))).max(axis=1) > 0).all()
    assert "A robot keeps driving at its target" in (folder / "README.md").read_text()


@pytest.mark.parametrize("learners", [1, 3])
def test_a_robot_remembers_until_it_has_another_target_or_number(
    learners: int, tmp_path: Path
) -> None:
    given = policies.arrays(hidden=(16, 16), learners=learners, names=NAMES)
    given, said = policies.recalling(given, 4, **several(learners), observation=METRIC)
    path = tmp_path / "policy.npz"
    saved(path, given, **said)
    assert export.main([f"policy={path}", "format=webots"]) == 0
    folder = tmp_path / "swarmjax_epuck"
    still = {"counts": [67.19] * 8, "compass": [0.0, 1.0, 0.0], "gps": [-0.5, 0.0, 0.0]}
    told = ["target=0,0"] * 3 + ["target=0,0.0001"] * 2 + ["target=0,0 robot=2"]
    done = _simulate(folder, [still | {"custom": word} for word in told], "action=mean")
    assert (done.returncode, done.stderr) == (0, "")
    wheels = _told(folder, len(told))
    # The observations are the same at each step, so differences come from the memory.
    assert np.abs(wheels[1] - wheels[0]).max() > 1e-3
    np.testing.assert_allclose(wheels[3], wheels[0], atol=1e-2)  # target moved by 0.1 mm of 0.5 m
    np.testing.assert_allclose(wheels[4], wheels[1], atol=1e-2)
    if learners == 1:
        np.testing.assert_array_equal(wheels[5], wheels[0])


def test_the_robots_number_may_be_in_custom_data(tmp_path: Path) -> None:
    _, folder = _exported(tmp_path, **several(3))
    step = {"counts": [67.19] * 8, "compass": [0.0, 1.0, 0.0], "gps": [0.0, 0.0, 0.0]}
    found = {}
    for custom, words in {
        "": ["target=0.3,0.2"],
        "robot=2": ["target=0.3,0.2"],
        "target=0.3,0.2 robot=1": ["robot=2"],
    }.items():
        done = _simulate(folder, [step | {"custom": custom}], "action=mean", *words)
        assert (done.returncode, done.stderr) == (0, "")
        found[custom] = _told(folder, 1)[0].tolist()
    first, *others = found.values()
    assert others == [others[0]] * 2  # robot 2; controllerArgs win over custom data
    assert first != others[0]


def test_a_control_step_that_webots_cannot_have_is_refused(tmp_path: Path) -> None:
    task = policies.meta()["task"] | {"control_step": 0.0325}
    trained = saved(tmp_path / "policy.npz", task=task)
    with pytest.raises(ValueError, match=r"^the control step of the policy is 32\.5 ms, but .*\.$"):
        webots_controller.control_period(trained, 32.5)


@pytest.mark.parametrize(
    ("words", "script", "sentence"),
    [
        (["goal=1,2"], {}, r"'goal=1,2' cannot be read: give target=x,y, robot=i or action=mean\."),
        (["target=1"], {}, r"'target=1' cannot be read: give target=x,y, robot=i or action=mean\."),
        ([], {"missing": ["gps"]}, r"the robot has no device 'gps': .* turretSlot\."),
        ([], {"basic": 20.0}, r"basicTimeStep is 20 ms: give 32 ms, .*\."),
        ([], {"basic": 64.0}, r"basicTimeStep is 64 ms: give 32 ms, .*\."),
        (["target=1,2", "robot=3"], {}, r"4 robots are too many: the policy has 3 networks\."),
        (["target=1,2", "robot=-1"], {}, r"'robot=-1' cannot be read: .*\."),
        (["target=nan,2"], {}, r"'target=nan,2' cannot be read: .*\."),
    ],
)
def test_what_it_cannot_do_it_says_in_one_sentence(
    words: list[str], script: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    _, folder = _exported(tmp_path, **several(3))
    step = {"counts": [67.19] * 8, "compass": [0.0, 1.0, 0.0], "gps": [0.0, 0.0, 0.0]}
    done = _simulate(folder, [step], *words, **script)
    assert done.returncode == 2
    assert re.fullmatch(rf"swarmjax_epuck: error: {sentence}\n", done.stderr), done.stderr


def test_a_damaged_policy_is_refused(tmp_path: Path) -> None:
    _, folder = _exported(tmp_path)
    content = (folder / "policy.npz").read_bytes()
    (folder / "policy.npz").write_bytes(content[:-40])
    done = _simulate(folder, [])
    assert done.returncode == 2
    assert re.fullmatch(r"swarmjax_epuck: error: [^\n]+\n", done.stderr)


def test_half_a_step_of_the_world_is_a_whole_one_of_the_policy(tmp_path: Path) -> None:
    _, folder = _exported(tmp_path)
    step = {"counts": [67.19] * 8, "compass": [0.0, 1.0, 0.0], "gps": [0.0, 0.0, 0.0]}
    assert _simulate(folder, [step], "target=1,1", basic=16.0).returncode == 0


def test_the_folder_says_what_it_is(tmp_path: Path) -> None:
    trained, folder = _exported(tmp_path, f"out={tmp_path / 'swarm-5'}")
    folder = tmp_path / "swarm-5"
    assert {path.name for path in folder.iterdir()} == {
        "swarm-5.py", "policy.py", "policy.npz", "sensors.json", "README.md"
    }  # fmt: skip
    readme = (folder / "README.md").read_text()
    assert "Untested in Webots itself" in readme
    assert trained.digest in readme
    assert "| 8 | target_distance | m | 0 | 1 |" in readme
    assert "swarmjax" not in re.sub(
        r'""".*?"""', "", (folder / "swarm-5.py").read_text(), flags=re.S
    )
    assert (folder / "policy.npz").read_bytes() == (tmp_path / "policy.npz").read_bytes()
