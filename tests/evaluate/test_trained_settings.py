"""Checks that a policy is judged with its training settings unless the command line differs."""

from dataclasses import replace
from pathlib import Path

import policies
import pytest
from sentences import refusal

from swarmjax.config import build, files
from swarmjax.evaluate import trained_settings
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.run.load_settings import load_train
from swarmjax.run.policy_export import policy_meta
from swarmjax.sim.realism_config import RealismConfig

ODD = ["stage=s3", "robot.hull_radius=0.044", "robot.sensor_range=0.1", "task.control_step=0.016"]


def _policy(path: Path, *words: str) -> str:
    """Writes a policy that was trained with these words."""
    meta = policy_meta(load_train([*words]), update=1, seed=0)
    policies.saved(path, **meta)
    return f"policy={path}"


def _load(*words: str) -> EvaluateConfig:
    return trained_settings.load(EvaluateConfig, words)[0]


@pytest.fixture
def odd(tmp_path: Path) -> str:
    return _policy(tmp_path / "odd.npz", *ODD, "realism=real", "realism.mass=null")


def test_hull_sensors_task_realism_and_stage_are_those_of_training(odd: str) -> None:
    found = _load(odd)
    assert (found.robot.hull_radius, found.stage.name) == (0.044, "s3")
    assert (found.robot.sensor_range, found.task.control_step) == (0.1, 0.016)
    real = build(RealismConfig, files.read_choice("realism", "real"))
    assert found.realism == replace(real, mass=None)


def test_the_rule_of_arrival_is_that_of_training(tmp_path: Path) -> None:
    word = _policy(tmp_path / "hold.npz", "task.arrival=hold")
    settings, said = trained_settings.load(EvaluateConfig, [word])
    assert settings.task.arrival == "hold"
    assert "arrival hold" in said
    assert _load(word, "task.arrival=latch").task.arrival == "latch"


def test_policies_of_both_rules_are_not_compared_until_told(tmp_path: Path) -> None:
    paths = [tmp_path / f"{rule}.npz" for rule in ("latch", "hold")]
    for path in paths:
        _policy(path, f"task.arrival={path.stem}")
    words = [f"compare={paths[0]},{paths[1]}"]
    sentence = refusal(_load, *words)
    assert "were trained with different values of task.arrival:" in sentence
    assert _load(*words, "task.arrival=hold").task.arrival == "hold"


def test_the_body_is_on_wheels_unless_it_is_told(odd: str) -> None:
    assert _load(odd).robot.body == "wheeled"
    assert _load(odd, "robot=planar").robot.body == "planar"


def test_what_is_typed_wins(odd: str) -> None:
    found = _load(odd, "robot.hull_radius=0.04", "robot.sensor_range=0.05", "stage=s1")
    assert (found.robot.hull_radius, found.robot.sensor_range) == (0.04, 0.05)
    assert (found.stage.name, found.task.control_step) == ("s1", 0.016)


def test_a_realism_that_is_typed_replaces_all_of_it(odd: str) -> None:
    assert _load(odd, "realism=ideal").realism == RealismConfig()


def test_a_robot_that_is_typed_changes_what_its_file_says(odd: str) -> None:
    found = _load(odd, "robot=wheeled_v2").robot
    assert (found.hull_radius, found.mass) == (0.044, 0.14)


def test_a_robot_file_without_a_body_leaves_that_of_the_judge(odd: str, tmp_path: Path) -> None:
    file = tmp_path / "slim.yaml"
    file.write_text("track: 0.05\n")
    found = _load(odd, f"robot={file}").robot
    assert (found.body, found.track, found.hull_radius) == ("wheeled", 0.05, 0.044)
    assert _load(odd, f"robot={file}", "robot.body=planar").robot.body == "planar"
    file.write_text("body: planar\n")
    assert _load(odd, f"robot={file}").robot.body == "planar"


def test_the_stage_of_training_may_be_changed(odd: str) -> None:
    found = _load(odd, "stage.side=1.1").stage
    assert (found.name, found.side) == ("s3", 1.1)


def test_a_limit_that_only_training_reads_is_refused(odd: str) -> None:
    assert refusal(trained_settings.load, EvaluateConfig, [odd, "task.step_limit=500"]) == (
        "task.step_limit works only in training: give steps=NUMBER instead."
    )


def test_the_first_line_says_what_was_taken_and_what_was_told(odd: str) -> None:
    said = trained_settings.load(EvaluateConfig, [odd, "robot.sensor_range=0.05"])[1]
    assert said.startswith("as trained but for robot.sensor_range=0.05: hull 0.044 m, infrared to ")
    assert said.endswith(
        "control step 0.016 s, arrival latch, realism custom; wheeled body with hulls of "
        "friction 1, stage s3, 1,500 control steps an episode (in training 500)"
    )
    alike = trained_settings.load(EvaluateConfig, [odd, "steps=500"])[1]
    assert alike.endswith("stage s3, 500 control steps an episode")


def test_the_first_line_does_not_take_a_file_of_realism_for_a_preset(tmp_path: Path) -> None:
    file = tmp_path / "noisy.yaml"
    file.write_text("infrared: real\nmass: [0.1, 0.2]\n")
    word = _policy(tmp_path / "p.npz", f"realism={file}")
    settings, said = trained_settings.load(EvaluateConfig, [word])
    assert settings.realism.mass == (0.1, 0.2)
    assert "realism custom" in said


@pytest.mark.parametrize(
    ("words", "friction"),
    [((), 1.0), (("robot=planar",), 1.0), (("robot.hull_friction=0.5",), 0.5)],
)
def test_hulls_rub_as_in_webots_whatever_the_training(
    words: tuple[str, ...], friction: float, tmp_path: Path
) -> None:
    both = [_policy(tmp_path / f"{x}.npz", f"robot.hull_friction={x}") for x in (0, 2)]
    names = ",".join(word.partition("=")[2] for word in both)
    assert _load(f"policy={names}", *words).robot.hull_friction == friction


def test_policies_that_were_trained_differently_need_a_word(tmp_path: Path) -> None:
    first, other = (_policy(tmp_path / f"{x}.npz", *ODD[: 1 + x]) for x in (0, 1))
    both = f"{first},{other.partition('=')[2]}"
    assert refusal(_load, both) == (
        f"{tmp_path / '0.npz'} and {tmp_path / '1.npz'} were trained with different values of "
        "robot.hull_radius: give one value for all policies, as in robot.hull_radius=0.044."
    )
    assert _load(both, "robot.hull_radius=0.037").robot.hull_radius == 0.037


def test_a_file_of_an_older_version_says_what_reads_it() -> None:
    meta = policies.meta()
    meta["realism"]["dropout"] = 0.1
    assert refusal(trained_settings.trained, meta, "p.npz") == (
        "p.npz: meta.realism.dropout is not a key of this version: if an older version wrote it, "
        "use that version."
    )


def test_a_file_without_a_config_says_what_its_own_keys_hold() -> None:
    meta = policies.meta(config={})
    meta["robot"] = {**meta["robot"], "track": 0.05}
    found = trained_settings.trained(meta, "p.npz")
    assert (found.robot.track, found.robot.hull_radius, found.stages) == (0.05, 0.037, [])
