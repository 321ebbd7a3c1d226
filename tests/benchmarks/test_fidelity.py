"""Tests the table of benchmarks.fidelity: its form, and some rows worked out by hand."""

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from sentences import refusal

from benchmarks import fidelity, fidelity_infrared, fidelity_motion, lines
from benchmarks import fidelity_rig as rig
from benchmarks.fidelity_rig import Rig, Row, beside
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.sim.config import RobotConfig
from swarmjax.task.stage_files import load_levels

BODIES = pytest.mark.parametrize("body", ["planar", "wheeled"])


@pytest.fixture(scope="module", params=["planar", "wheeled"])
def bench(request: pytest.FixtureRequest) -> Rig:
    return rig.load(RobotConfig(body=request.param))


@pytest.fixture(scope="module")
def wheeled() -> Rig:
    return rig.load(RobotConfig(body="wheeled"))


@BODIES
def test_the_rig_steps_as_the_judge_does(body: str) -> None:
    settings = load_levels(EvaluateConfig, ["policy=none", f"robot={body}"])
    assert rig.SUBSTEPS[body] == evaluate_judge.substeps(settings)
    assert settings.task.control_step == rig.CONTROL_STEP


def test_mass_and_inertia_are_those_of_the_model(bench: Rig) -> None:
    assert rig.mass(bench) == pytest.approx(0.16, abs=1e-12)  # float64's rounding.
    # The robot's setting is 1.06e-4 kg m^2, which MuJoCo keeps in float64.
    assert rig.yaw_inertia(bench) == pytest.approx(1.06e-4, rel=1e-9)


def test_another_mass_is_measured() -> None:
    heavy = rig.load(RobotConfig(body="wheeled", mass=0.2))
    assert rig.mass(heavy) == pytest.approx(0.2, abs=1e-12)  # float64's rounding.
    # The height is (0.19 * 0.015 + 0.01 * 0.02) / 0.2, less the 0.01 mm by which the robot stands
    # in the floor.
    height = 0.01525 - 1e-5
    assert rig.centre(heavy)[2] == pytest.approx(height, abs=1e-9)


@pytest.mark.parametrize("radius", [0.037, 0.040])
def test_the_hull_is_felt_and_seen_at_its_radius(radius: float) -> None:
    bench = rig.load(RobotConfig(hull_radius=radius))
    # The direction of the wall's face is kept in float32, with an error of 1e-7 of the 2.5 m along
    # the face.
    assert rig.contact_radius(bench) == pytest.approx(radius, abs=1e-6)
    seen = 0.2 - rig.cast(bench, (0.2, 0.0, 0.033), (-1, 0, 0))
    assert seen == pytest.approx(radius, abs=1e-9)  # float64's rounding


@pytest.mark.parametrize(
    ("command", "realised"),
    [
        # The wheels should turn at 2.168 and 10.332 rad/s, and the latter is clamped to 6.28 rad/s:
        # v = 0.01 (2.168 + 6.28), w = (6.28 - 2.168) 0.02 / 0.052.
        ((0.125, 3.14), (0.08448, 1.58154)),
        # The wheels should turn at 7.334 and 11.416 rad/s, so both are clamped.
        ((0.1875, 1.57), (0.1256, 0.0)),
    ],
)
def test_a_clamped_command(
    bench: Rig, command: tuple[float, float], realised: tuple[float, float]
) -> None:
    # The tolerance of 1e-3 is for the creep of the wheeled body on the floor.
    found = rig.steady(bench, *command)
    assert found == pytest.approx(realised, rel=1e-3, abs=1e-9)


def test_speed_along_an_arc_is_not_that_of_its_chord() -> None:
    # The robot drives a quarter of a circle of radius 1 m in 2 control steps of 0.032 s.
    angle = np.linspace(0.0, 0.5 * math.pi, 3)
    pose = np.stack([np.sin(angle), 1.0 - np.cos(angle), angle], axis=-1)
    track = rig.Track(pose, pose, pose, np.zeros(3))
    expected = 0.5 * math.pi / 0.064
    found = rig.velocity(rig.load(RobotConfig()), track)
    assert found == pytest.approx((expected, expected), rel=1e-12)  # float64's rounding


def test_ten_revolutions_show_the_track(bench: Rig) -> None:
    share, track, drift = fidelity_motion.turned(bench, 0.057)
    # The tolerance of 1e-3 is for creep on the floor. Nothing pushes the robot aside.
    assert share == pytest.approx(0.052 / 0.057, rel=1e-3)
    assert track == pytest.approx(0.057, rel=1e-3)
    assert drift < 1e-6


def test_speed_above_which_no_turn_is_left() -> None:
    # No turn is left once the slower wheel is also at its limit: (v - 3.14 * 0.026) / 0.02 = 6.28.
    # The bisection stops at 1e-5 m/s. It counts turn rates below 1e-3 rad/s as no turn, which is
    # 2.6e-5 m/s at the rim of the slower wheel.
    found = fidelity_motion.turning_ends(rig.load(RobotConfig()))
    assert found == pytest.approx(0.1256 + 0.08164, abs=6e-5)


def test_a_start_is_limited_by_friction() -> None:
    for friction in (1.0, 0.5):
        bench = rig.load(RobotConfig(friction=friction), timestep=1e-4)
        expected = 0.1256 / (friction * 9.81)
        # The tolerance is one physics step of 0.1 ms.
        assert fidelity_motion.reach_time(bench, (0.25, 0.0)) == pytest.approx(expected, abs=1e-4)


def test_a_lagging_motor_follows_its_closed_form(bench: Rig) -> None:
    # The wheeled body creeps; the planar body is exact.
    assert fidelity_motion.lag_error(bench) < 2e-3


def test_a_skid_takes_its_share_of_a_push(wheeled: Rig) -> None:
    track = fidelity_motion.blocked(wheeled)
    # The wall pushes with a force F at a height of 0.015 m, so the skid at 0.025 m carries 0.6 F.
    # The wheels push with the weight that is left: F = 1.5696 N - 0.6 F. The tolerance of 1 % is
    # for the mean force of a robot that hops.
    assert track.force[-100:].mean() == pytest.approx(0.981, rel=0.01)


def test_pitch_before_a_skid_touches(wheeled: Rig) -> None:
    # The pitch is atan(0.0001 / 0.025). The tolerance of 0.01 degrees is for the floor, which
    # yields by 1e-6 m under a load of 0.04 N.
    assert fidelity_motion.pitch_play(wheeled) == pytest.approx(0.2292, abs=0.01)


def test_rays_before_a_wall(bench: Rig) -> None:
    rays = fidelity_infrared.see(bench, 0.010)
    # The rays lead from x = 0.030 m and 0.022 m to 0.047 m, at yaws of 0.30081 and 0.80081 rad. The
    # tolerance of 1e-6 m is for the direction of the wall's face, 2.5 m long, in float32.
    assert rays[0] == pytest.approx(0.017 / math.cos(0.30081), abs=1e-6)
    assert rays[1] == pytest.approx(0.025 / math.cos(0.80081), abs=1e-6)
    # The third ray leads to the side, through the robot's own wheel.
    assert rays[2] == pytest.approx(1.0 - 0.031, abs=1e-6)


def test_where_a_falling_reading_passes_a_level() -> None:
    found = fidelity_infrared.falls_to(lambda distance: 100.0 - 1000.0 * distance, 60.0)
    assert found == pytest.approx(0.04, abs=1e-7)  # the bisection stops at this error


def test_an_error_is_that_of_the_worse_body() -> None:
    assert Row("", "", "", 2.0, "", 2.2, 1.9).error == pytest.approx(0.1)
    assert Row("", "", "", -2.0, "", None, -1.0).error == 0.5
    assert Row("", "", "", 0.0, "", 1.0, 1.0).error is None
    assert Row("", "", "", None, "", 1.0, 1.0).error is None
    assert Row("", "", "", 1.0, "", None, None).error is None


def test_a_row_for_each_source() -> None:
    rows = beside("S", "q", "m", {"a": 1.0, "b": None}, (None, 2))
    assert rows == [
        Row("S", "q", "m", 1.0, "a", None, 2.0),
        Row("S", "q", "m", None, "b", None, 2.0),
    ]


ROWS = [
    Row("One", "q", "m", 2.0, "a", 1.0, None),
    Row("Two", "r", "1", None, "b", 1e-15, 12.3456789),
]


def test_the_table_has_a_part_for_each_section() -> None:
    text = io.StringIO()
    fidelity.print_table(ROWS, Console(file=text, width=80))
    assert [line.split() for line in text.getvalue().splitlines()] == [
        ["quantity", "unit", "theirs", "source", "planar", "wheeled", "error"],
        *(["One"], ["q", "m", "2", "a", "1", "50.00", "%"]),
        *(["Two"], ["r", "1", "b", "0", "12.346"]),
    ]


def test_lines_of_json(tmp_path: Path) -> None:
    path = tmp_path / "new" / "rows.jsonl"
    fidelity.write_lines(path, ROWS)
    head, *rest = [json.loads(line) for line in path.read_text().splitlines()]
    assert head["benchmark"] == "fidelity"
    assert {"versions", "commit", "substeps"} <= head.keys()
    assert rest[0] == {
        **{"section": "One", "quantity": "q", "unit": "m", "theirs": 2.0, "source": "a"},
        **{"planar": 1.0, "wheeled": None, "error": 0.5},
    }


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    assert "out is" in refusal(fidelity.write_lines, tmp_path, ROWS)


@pytest.mark.parametrize(
    ("word", "part"), [("ot=x", "did you mean out?"), ("out", "give key=value")]
)
def test_words_that_are_refused(word: str, part: str) -> None:
    assert part in refusal(lines.load, fidelity.FidelityConfig, [word])


def test_a_path_may_look_like_a_number() -> None:
    assert lines.load(fidelity.FidelityConfig, ["out=3"]) == fidelity.FidelityConfig(out="3")
