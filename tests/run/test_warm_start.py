"""Checks `init_from=DIR`: what a new run takes from an earlier run, and what is refused."""

import json
import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from swarmjax import command, train
from swarmjax.config import to_dict
from swarmjax.run import checkpoint, warm_start
from swarmjax.run.checkpoint import CheckpointError, Checkpoints, Kept, digest
from swarmjax.run.load_settings import load_train, read_config
from swarmjax.run.settings import TrainConfig
from swarmjax.training import mesh
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState

UPDATES = 3
TINY = [
    "stage=s1",
    "sim.impl=jax",
    "sim.max_robots=2",
    "sim.max_obstacles=0",
    "arenas=4",
    "algo.rollout_length=4",
    "algo.num_minibatches=2",
    "algo.epochs=1",
    "algo.hidden_sizes=[8]",
    "task.step_limit=8",
    f"budget={4 * 4 * UPDATES}",
    "run.tensorboard=false",
]
# Another body, realism, arena and budget, with the same observations as TINY. With realism=real, an
# episode must be longer than the stalls of 0.3 s.
OTHER = [
    "robot=wheeled",
    "realism=real",
    "stage.side=1.5",
    "task.step_limit=16",
    "seed=7",
    f"budget={4 * 4 * 50}",
]
CARRIED = ("learners/params/", "learners/normalizer/")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a run of three updates, with checkpoints after the second and the third."""
    run = tmp_path_factory.mktemp("trained") / "run"
    words = [f"run.dir={run}", "run.chunk=1", "run.checkpoint_minutes=0"]
    assert train.main([*TINY, *words]) == 0
    return run


def _load(words: list[str]) -> tuple[Kept, TrainState, TrainConfig]:
    """Returns the source of a warm start, the state of the run without it, and the config."""
    settings = load_train([*TINY, *words])
    source = warm_start.read(settings)
    assert source is not None
    program, schedule = programs.load(settings)
    return source, jax.jit(mesh.init(program))(schedule), settings


def _rows(run: Path) -> list[dict]:
    """Reads the metrics of a run, without the training time."""
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(line).items() if k != "train_s"} for line in lines]


def _refusal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str
) -> str:
    """Runs a training that must be refused and returns its one sentence."""
    monkeypatch.setattr(sys, "argv", ["train", *words])
    capsys.readouterr()
    assert command.run("train", train.main, TrainConfig, (CheckpointError,)) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.endswith("\n")
    assert captured.err.count("\n") == 1
    return captured.err.removeprefix("swarmjax.train: error: ").rstrip("\n")


def _flip_one_bit(run: Path, step: int) -> None:
    """Damages the largest file of a checkpoint, in the middle."""
    files = checkpoint.path_of(run, step).rglob("*")
    file = max(files, key=lambda path: path.is_file() * path.stat().st_size)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def test_networks_and_normaliser_are_carried_and_nothing_else(trained: Path) -> None:
    source, state, settings = _load([*OTHER, f"init_from={trained}"])
    found = checkpoint.to_leaves(warm_start.carry(source, state, settings))
    fresh = checkpoint.to_leaves(state)
    learned = checkpoint.find(trained)[0]
    assert found.keys() == fresh.keys()
    carried = {name for name in found if name.startswith(CARRIED)}
    # The networks have a kernel and a bias in each of 2 x 2 layers, and log_std. The normaliser has
    # count, mean and variance.
    assert len(carried) == 2 * 2 * 2 + 1 + 4
    for name, leaf in found.items():
        expected = learned[name] if name in carried else fresh[name]
        np.testing.assert_array_equal(leaf, expected, err_msg=name, strict=True)
    # Training has changed every carried leaf and the optimiser, so the comparison above can fail.
    for name in carried | {name for name in found if "/mu/" in name}:
        assert np.any(learned[name] != fresh[name]), name
    counts = [name for name in found if name.endswith("/count") and "optimizer_state" in name]
    assert counts
    for name in counts:
        assert learned[name].tolist() == [[UPDATES * 2]], name  # one step for each minibatch
        assert found[name].tolist() == [[0]], name
    assert (learned["update"].tolist(), found["update"].tolist()) == ([UPDATES], [0])


def test_it_is_known_how_many_robots_have_trained(trained: Path) -> None:
    # Two robots have trained, and the new run begins with one. Its promotions must not copy a
    # learner over a learner that has trained.
    source, state, settings = _load(["stage.robots=1", f"init_from={trained}"])
    assert state.curriculum.met.tolist() == [1]
    assert warm_start.carry(source, state, settings).curriculum.met.tolist() == [2]


SCHEDULED = ["algo.exploration=scheduled", "algo.std_interval=30"]
EXPLORED = "learners/explored"


@pytest.mark.slow
def test_a_schedule_of_exploration_goes_on(trained: Path, tmp_path: Path) -> None:
    words = [*TINY, *SCHEDULED, f"run.dir={tmp_path / 'run'}"]
    assert train.main(words) == 0

    def explored(*words: str) -> list[int] | None:
        settings = load_train([*TINY, *words])
        source, state, _ = _load([w for w in words if w not in TINY])
        found = checkpoint.to_leaves(warm_start.carry(source, state, settings)).get(EXPLORED)
        return None if found is None else found[0].tolist()

    begun = f"init_from={tmp_path / 'run'}"
    assert explored(*SCHEDULED, begun) == [UPDATES * 16]  # four arenas, rollouts of four
    # A learned deviation has no schedule that could go on.
    assert explored(*SCHEDULED, f"init_from={trained}") == [0]
    assert explored(begun) is None


@pytest.fixture(scope="module")
def pair(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a run of two seeds; the second seed has the numbers of the first, plus 1."""
    run = tmp_path_factory.mktemp("pair") / "run"
    learned = checkpoint.find(trained)[0]
    lanes = {name: np.concatenate([leaf, leaf + 1]) for name, leaf in learned.items()}
    lanes["update"] = np.full(2, UPDATES)
    run.mkdir()
    stored = read_config(trained) | {"seeds": 2}
    (run / "config.json").write_text(json.dumps(stored))
    with Checkpoints(run) as checkpoints:
        checkpoints.save(lanes, UPDATES)
    return run


@pytest.mark.slow
def test_several_seeds_begin_with_as_many_lane_by_lane(trained: Path, pair: Path) -> None:
    source, state, settings = _load([f"init_from={pair}", "seeds=2", "seed=5"])
    found = checkpoint.to_leaves(warm_start.carry(source, state, settings))
    learned = checkpoint.find(trained)[0]
    for name in (name for name in found if name.startswith(CARRIED)):
        expected = np.concatenate([learned[name], learned[name] + 1])
        np.testing.assert_array_equal(found[name], expected, err_msg=name, strict=True)


@pytest.mark.slow
def test_several_seeds_may_all_begin_with_the_same_one(trained: Path) -> None:
    source, state, settings = _load([f"init_from={trained}", "seeds=3"])
    found = checkpoint.to_leaves(warm_start.carry(source, state, settings))
    fresh, learned = checkpoint.to_leaves(state), checkpoint.find(trained)[0]
    for name, leaf in found.items():
        expected = fresh[name]
        if name.startswith(CARRIED):
            expected = np.concatenate([learned[name]] * 3)
        np.testing.assert_array_equal(leaf, expected, err_msg=name, strict=True)


@pytest.mark.parametrize("count", [1, 3, 4])
def test_any_other_number_of_seeds_is_refused(
    count: int, pair: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sentence = _refusal(capsys, monkeypatch, *TINY, f"init_from={pair}", f"seeds={count}")
    assert sentence == (
        f"init_from is '{pair}', a run of 2 seeds, but seeds is {count}: give seeds=2, or "
        "init_from a run of one seed."
    )


@pytest.mark.slow
def test_a_damaged_checkpoint_is_passed_over_and_said(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged, run = tmp_path / "damaged", tmp_path / "run"
    shutil.copytree(trained, damaged)
    _flip_one_bit(damaged, 3)
    assert train.main([*TINY, f"init_from={damaged}", f"run.dir={run}", "run.stop_after=0"]) == 0
    output = capsys.readouterr().out
    assert f"checkpoint 3 of {damaged} cannot be used (" in output
    assert f"the networks and the normaliser of {damaged} after 2 updates" in output
    found, update, *_ = checkpoint.find(run)
    assert update == 0
    before = checkpoint.find(trained, 2)[0]
    for name in (name for name in found if name.startswith(CARRIED)):
        np.testing.assert_array_equal(found[name], before[name], err_msg=name, strict=True)


@pytest.mark.slow
def test_a_started_run_resumes_without_the_run_it_started_from(
    trained: Path, tmp_path: Path
) -> None:
    gone, whole, parts = tmp_path / "gone", tmp_path / "whole", tmp_path / "parts"
    shutil.copytree(trained, gone)
    words = [*TINY, f"init_from={gone}", "seed=1"]
    assert train.main([*words, f"run.dir={whole}"]) == 0
    assert train.main([*words, f"run.dir={parts}", "run.stop_after=1"]) == 0
    shutil.rmtree(gone)
    assert train.main([f"resume={parts}"]) == 0
    for run in (whole, parts):
        assert read_config(run)["init_from"] == str(gone)
    assert digest(checkpoint.find(parts)[0]) == digest(checkpoint.find(whole)[0])
    assert [row["update"] for row in _rows(parts)] == list(range(UPDATES))
    assert _rows(parts) == _rows(whole)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (
            ["algo.policy=independent"],
            "a run with algo.policy=shared, but here algo.policy is independent: give "
            "algo.policy=shared",
        ),
        (
            ["algo.hidden_sizes=[8,8]"],
            "a run with algo.hidden_sizes=[8], but here algo.hidden_sizes is [8,8]: give "
            "algo.hidden_sizes=[8]",
        ),
        (
            ["algo.memory=gru", "algo.rollout_length=8"],
            "a run with algo.memory=none, but here algo.memory is gru: give algo.memory=none",
        ),
        (
            ["algo.critic=state"],
            "a run with algo.critic=observation, but here algo.critic is state: give "
            "algo.critic=observation",
        ),
        (
            ["algo.activation=relu"],
            "a run with algo.activation=tanh, but here algo.activation is relu: give "
            "algo.activation=tanh",
        ),
        (
            ["algo.mean_activation=tanh"],
            "a run with algo.mean_activation=linear, but here algo.mean_activation is tanh: give "
            "algo.mean_activation=linear",
        ),
        (
            ["realism=webots"],
            "a run with task.encoding=metric, but here task.encoding is webots: give "
            "task.encoding=metric",
        ),
    ],
)
@pytest.mark.slow
def test_other_networks_are_refused(
    words: list[str],
    what: str,
    trained: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sentence = _refusal(capsys, monkeypatch, *TINY, *words, f"init_from={trained}")
    assert sentence == f"init_from is '{trained}', whose {what}, or another run."


@pytest.mark.parametrize("word", ["algo.memory=none", "algo=paper"])
def test_a_run_that_remembers_names_the_memory_that_it_has(
    word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = to_dict(load_train([*TINY, "algo.memory=gru", "algo.rollout_length=8"]))
    (tmp_path / "config.json").write_text(json.dumps(stored))
    monkeypatch.chdir(tmp_path)
    said = _refusal(capsys, monkeypatch, *TINY[:4], "arenas=8", "init_from=.", word)
    assert said.startswith("init_from is '.', a run with ")
    assert "memory_size is 64, but memory is none" not in said


def test_independent_learners_are_told_how_many_they_were(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = to_dict(load_train([*TINY, "algo.policy=independent"]))
    (tmp_path / "config.json").write_text(json.dumps(stored))
    monkeypatch.chdir(tmp_path)
    assert _refusal(capsys, monkeypatch, *TINY, "init_from=.", "sim.max_robots=3") == (
        "init_from is '.', a run with sim.max_robots=2, but here sim.max_robots is 3: give "
        "sim.max_robots=2, or another run."
    )


def test_what_is_no_sound_run_is_refused(
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [*TINY, "init_from=bad", "run.dir=new"]
    takes = (
        "init_from is 'bad', which must be the directory of a run with a usable checkpoint, but "
    )
    sentence = _refusal(capsys, monkeypatch, *words)
    assert sentence == f"{takes}bad is not a run directory: it has no config.json."

    shutil.copytree(trained, "bad", ignore=shutil.ignore_patterns("checkpoints"))
    sentence = _refusal(capsys, monkeypatch, *words)
    assert sentence == f"{takes}bad has no checkpoints: give a run directory that has some."

    shutil.copytree(trained / "checkpoints", "bad/checkpoints")
    for step in (2, 3):
        _flip_one_bit(Path("bad"), step)
    sentence = _refusal(capsys, monkeypatch, *words)
    assert sentence.startswith(
        f"{takes}bad has no usable checkpoint: checkpoint 3 of bad cannot be used"
    )
    assert not Path("new").exists()


def test_a_checkpoint_that_its_config_belies_is_refused(
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stored = read_config(trained)
    stored["algo"]["hidden_sizes"] = [16]
    (tmp_path / "config.json").write_text(json.dumps(stored))
    (tmp_path / "checkpoints").symlink_to(trained / "checkpoints")
    words = [f"init_from={tmp_path}", "algo.hidden_sizes=[16]", f"run.dir={tmp_path / 'new'}"]
    sentence = _refusal(capsys, monkeypatch, *TINY, *words)
    assert sentence.startswith(f"init_from is '{tmp_path}', which must be the directory of a run")
    assert sentence.endswith("cannot be used (it was written with another config.json).")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["init_from=a", "resume={}"],
            "init_from=a cannot be given: a resumed run keeps its settings, and only budget, "
            "devices, resume, run.*, streams, extensions may change.",
        ),
        (["init_from="], "init_from is '': give text or null."),
    ],
)
@pytest.mark.slow
def test_keys_that_do_not_fit_together_are_refused(
    words: list[str],
    sentence: str,
    trained: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = [word.format(trained) for word in words]
    assert _refusal(capsys, monkeypatch, *words) == sentence


def test_robot_task_realism_and_network_are_those_of_the_source(tmp_path: Path) -> None:
    words = [*TINY, "robot.hull_radius=0.04", "robot.sensor_range=0.06", "realism=webots"]
    stored = to_dict(load_train([*words, "algo.hidden_sizes=[16]", "algo.activation=relu"]))
    (tmp_path / "config.json").write_text(json.dumps(stored))
    found = load_train([f"init_from={tmp_path}", "stage=s1", "robot.sensor_range=0.05"])
    assert (found.robot.hull_radius, found.robot.sensor_range) == (0.04, 0.05)
    assert (found.realism.infrared, found.algo.activation) == ("webots", "relu")
    assert found.algo.hidden_sizes == (16,)
    assert found.algo.rollout_length == load_train([]).algo.rollout_length
