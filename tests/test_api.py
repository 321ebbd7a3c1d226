"""Tests the four functions of swarmjax's Python interface, and what they refuse."""

import importlib
import itertools
import pkgutil
import subprocess
import sys
from pathlib import Path

import chex
import extensions
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmjax
from swarmjax.environment import Swarm, SwarmState
from swarmjax.task.stage_config import StageConfig

PAIR = StageConfig(name="pair", robots=2, side=0.5)
TRIO = StageConfig(name="trio", robots=3, side=0.8, obstacles=1)
LIMIT, ARENAS = 6, 4
TINY = {
    "stage": [PAIR, TRIO],
    "sim.impl": "jax",
    "arenas": 4,
    "algo": {"rollout_length": 4, "num_minibatches": 2, "epochs": 1, "hidden_sizes": [8]},
    "task.step_limit": 8,
    "budget": 4 * 4 * 6,
    "run.tensorboard": False,
    "run.chunk": 1,
}


@pytest.fixture(scope="module")
def env() -> Swarm:
    return swarmjax.make_env(
        [PAIR, TRIO], task={"step_limit": LIMIT}, sim={"impl": "jax"}, arenas=ARENAS
    )


@pytest.fixture(scope="module")
def states(env: Swarm) -> list[SwarmState]:
    """Returns the first state and the state after each of 14 control steps without motion."""
    state = jax.jit(env.reset)(jax.random.key(0))
    step, found = jax.jit(env.step), [state]
    still = jnp.tile(jnp.array([-1.0, 0.0]), (ARENAS, env.num_robots, 1))
    for _ in range(14):
        found.append(step(found[-1], still)[0])
    return found


def test_importing_the_package_imports_no_jax() -> None:
    code = "import sys, swarmjax; swarmjax.__version__; print('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_no_module_shadows_a_function() -> None:
    for module in pkgutil.walk_packages(swarmjax.__path__, "swarmjax."):
        if not any(part in module.name for part in (".templates", "_warp", ".adapters.")):
            importlib.import_module(module.name)
    functions = ("make_env", "train_policy", "evaluate_policy", "load_policy")
    assert all(callable(getattr(swarmjax, name)) for name in functions)
    assert not set(functions) & {module.name for module in pkgutil.iter_modules(swarmjax.__path__)}


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'no_such'"):
        swarmjax.no_such  # noqa: B018 # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.slow
def test_arenas_play_the_stages_in_turn(env: Swarm, states: list[SwarmState]) -> None:
    assert (env.num_arenas, env.num_robots) == (ARENAS, 3)
    np.testing.assert_array_equal(states[0].present.sum(axis=1), [2, 3, 2, 3])


def test_spaces_say_what_goes_in_and_out(env: Swarm, states: list[SwarmState]) -> None:
    seen, action = env.observation_space, env.action_space
    assert seen.shape == states[0].observation.shape[2:] == (len(seen.names),)
    assert (action.shape, action.names) == ((2,), ("speed", "turn_rate"))


def test_an_episode_that_is_over_gives_way_to_another(states: list[SwarmState]) -> None:
    start = [np.array(state.arenas.level.start) for state in states]
    for before, after in zip(range(LIMIT - 1), range(1, LIMIT), strict=True):
        np.testing.assert_array_equal(start[before], start[after])
    for arena in range(ARENAS):  # each has a new level after every step limit
        assert len({start[i][arena].tobytes() for i in (0, LIMIT, 2 * LIMIT)}) == 3
    np.testing.assert_array_equal(states[LIMIT].arenas.clock, 0)


def test_waiting_episodes_are_drawn_again_once_they_are_played(states: list[SwarmState]) -> None:
    waiting = [np.array(state.waiting.level.start) for state in states]
    changed = [bool((a != b).any()) for a, b in itertools.pairwise(waiting)]
    assert [n + 1 for n, new in enumerate(changed) if new] == [LIMIT, 2 * LIMIT]
    assert not any(state.played.any() for state in states)


def test_the_step_has_the_old_episode_and_the_state_the_new_one(
    env: Swarm, states: list[SwarmState]
) -> None:
    still = jnp.tile(jnp.array([-1.0, 0.0]), (ARENAS, env.num_robots, 1))
    state, came = jax.jit(env.step)(states[LIMIT - 1], still)
    assert came.done.all()
    present = states[0].present
    assert not np.allclose(came.observation[present], state.observation[present])
    np.testing.assert_array_equal(came.truncated, present)


def test_the_same_key_gives_the_same_episodes(env: Swarm, states: list[SwarmState]) -> None:
    again = jax.jit(env.reset)(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, again.arenas, states[0].arenas)
    jax.tree.map(np.testing.assert_array_equal, again.waiting, states[0].waiting)


@pytest.mark.slow
def test_it_runs_under_vmap_as_alone(env: Swarm, states: list[SwarmState]) -> None:
    keys = jnp.stack([jax.random.key(0), jax.random.key(1)])
    pair = jax.vmap(env.reset)(keys)
    action = jnp.zeros((2, ARENAS, env.num_robots, 2))
    after, _ = jax.jit(jax.vmap(env.step))(pair, action)
    alone, _ = jax.jit(env.step)(states[0], action[0])
    # XLA fuses a batch differently, so it rounds differently.
    np.testing.assert_allclose(after.observation[0], alone.observation, atol=1e-5)


def test_poses_are_where_the_level_starts(env: Swarm, states: list[SwarmState]) -> None:
    np.testing.assert_allclose(env.pose(states[0]), states[0].arenas.level.start, atol=1e-6)


@pytest.mark.slow
def test_every_seed_has_its_policy(tmp_path: Path) -> None:
    settings = TINY | {"run.dir": tmp_path / "run", "seeds": 2, "budget": 16}
    result = swarmjax.train_policy(settings)
    assert [each.meta["seed"] for each in result.policies] == [0, 1]


@pytest.mark.slow
def test_a_run_goes_on(tmp_path: Path) -> None:
    settings = TINY | {"run.dir": tmp_path / "run", "budget": 32}
    first = swarmjax.train_policy(settings, on_update=lambda row: row["update"] == 0)
    second = swarmjax.train_policy({"resume": first.run})
    whole = swarmjax.train_policy(settings | {"run.dir": tmp_path / "whole"})
    assert first.policy.meta["update"] < second.policy.meta["update"]
    chex.assert_trees_all_equal(second.policy.layers, whole.policy.layers)


@pytest.mark.slow
def test_pieces_handed_over_are_trained_and_judged(tmp_path: Path) -> None:
    settings = TINY | {"stage": extensions.RING, "run.dir": tmp_path / "run", "budget": 16}
    result = swarmjax.train_policy(settings, extensions=str(extensions.OWN))
    assert result.policy.meta["observation"]["names"][-1] == "nearest_robot"
    assert result.policy.meta["network"] == "residual"
    found = swarmjax.evaluate_policy(
        result.policy, extensions=str(extensions.OWN), episodes=2, steps=5
    )
    assert [cell["cell"] for cell in found["cells"]] == ["ring"]
    with pytest.raises(swarmjax.SwarmjaxError, match="the Python file that defines this level"):
        swarmjax.evaluate_policy(result.policy, episodes=2)
    with pytest.raises(swarmjax.SwarmjaxError, match="was trained with the network residual of "):
        swarmjax.load_policy(result.run / "policy.npz")


@pytest.mark.parametrize(
    "call", [swarmjax.make_env, lambda: swarmjax.train_policy({"stage": "s1"})]
)
def test_64_bits_are_refused_in_one_sentence(
    call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with jax.enable_x64(True), pytest.raises(swarmjax.SwarmjaxError) as caught:
        call()
    assert str(caught.value) == (
        "jax_enable_x64 is on, but arenas and learners compute in 32 bits: switch it off, as in "
        "JAX_ENABLE_X64=0."
    )
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: swarmjax.make_env("s7"), r"^stage is 's7': give s6 \(the most similar name\) or"),
        (lambda: swarmjax.make_env("s3", robot={"hull_radius": -1}), r"^robot\.hull_radius is -1: "
        ""),
        (lambda: swarmjax.make_env("s3", robot="legs"), r"^robot is 'legs': give one of khepera4"),
        (lambda: swarmjax.make_env("s3", arenas=0), r"^arenas is 0: give 1 to 1048576"),
        (lambda: swarmjax.make_env("s3", extensions="no.py"), r"^extensions is 'no.py', but no"),
        (lambda: swarmjax.train_policy({"algo.hidden": [8]}), r"^algo\.hidden is not a key: did y"),
        (lambda: swarmjax.evaluate_policy("no.npz"), r"^no\.npz is not a file: give the path of "),
        (lambda: swarmjax.load_policy("no.npz"), r"^no\.npz is not a file: give the path of "),
    ],
)  # fmt: skip
def test_errors_are_one_class_with_the_sentences_of_the_commands(call, sentence: str) -> None:
    with pytest.raises(swarmjax.SwarmjaxError, match=sentence):
        call()
