"""Checks that the command printed for the next step can be pasted, for every kind of run."""

import shlex
from pathlib import Path

import extensions
import pytest

from swarmjax import train
from swarmjax.evaluate import __main__ as evaluate

TINY = [
    "sim.impl=jax",
    "arenas=4",
    "algo.rollout_length=4",
    "algo.num_minibatches=2",
    "algo.epochs=1",
    "algo.hidden_sizes=[8]",
    "task.step_limit=8",
    "run.tensorboard=false",
]
PAPER = ["algo=paper", "stage=paper1", "algo.rollout_length=8", "algo.epochs=1", "arenas=1"]
KINDS = {
    "hull": [*TINY, "stage=s1", "robot.hull_radius=0.044", "robot.sensor_range=0.1"],
    "curriculum": [*TINY, "stage.sequence=[s1,s2]"],
    "seeds": [*TINY, "stage=s1", "seeds=2", "seed=3"],
    "paper": [*PAPER, "task.step_limit=8", "run.tensorboard=false"],
    "own": [*TINY, f"stage={extensions.RING}", f"extensions={extensions.OWN}"],
    "a space": [*TINY, "stage=s1", "realism=webots"],
}


def _pasted(text: str, name: str) -> list[str]:
    """Returns the arguments of the command at the end of a text."""
    # As a shell does, but not shlex: a backslash joins lines.
    words = shlex.split(text[text.rindex("python -m") :].replace("\\\n", ""))
    assert words[:3] == ["python", "-m", f"swarmjax.{name}"]
    return words[3:]


SLOW = ("grid", "seeds", "paper", "hull", "own")


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in SLOW)) for kind in KINDS]
)
@pytest.mark.slow
def test_the_policy_is_judged_by_the_command_as_printed(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = KINDS[kind]
    assert train.main([*words, "budget=32", f"run.dir={tmp_path / kind}"]) == 0
    printed = capsys.readouterr().out
    used = "reward turning, observation nearest_robot, level ring, network residual"
    assert (used in " ".join(printed.split())) == (kind == "own")
    arguments = _pasted(printed, "evaluate")
    assert evaluate.main([*arguments, "episodes=2", "steps=3", "workers=1"]) == 0
    said = capsys.readouterr().out.splitlines()[0]
    assert ("hull 0.044 m, infrared to 0.1 m" in said) == (kind == "hull")


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_by_the_command_as_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*KINDS["a space"], "budget=64", "run.stop_after=2", f"run.dir={tmp_path / 'a run'}"]
    assert train.main(words) == 0
    assert train.main(_pasted(capsys.readouterr().out, "train")) == 0
    assert "done; evaluate the policy with:" in capsys.readouterr().out
