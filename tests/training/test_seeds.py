"""Checks seeds in one program: each seed is a run that the other seeds do not affect."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.curriculum import engine as curriculum
from swarmjax.run.checkpoint import Leaves, to_leaves
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import physics
from swarmjax.task.world import World
from swarmjax.training import loop, mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Program

SEEDS, UPDATES = 3, np.int32(2)
Run = Callable[[TrainState, np.int32], tuple[TrainState, dict]]


def _program(config: TrainConfig, world: World, count: int, first: int = 0) -> Program:
    return programs.build(replace(config, seed=first, seeds=count), world)


def _start(program: Program) -> TrainState:
    return jax.jit(mesh.init(program))(programs.schedule(program.config))


def _run(program: Program) -> Run:
    return partial(jax.jit(seeds.chunk(program)), programs.schedule(program.config))


@pytest.fixture(scope="module")
def side_by_side(tiny_config: TrainConfig, tiny_world: World) -> Program:
    return _program(tiny_config, tiny_world, SEEDS)


@pytest.fixture(scope="module")
def start(side_by_side: Program) -> TrainState:
    return _start(side_by_side)


@pytest.fixture(scope="module")
def run(side_by_side: Program) -> Run:
    """Trains all seeds; tracing it a second time is an error."""

    def chunk(
        schedule: curriculum.Schedule, state: TrainState, n: np.int32
    ) -> tuple[TrainState, dict]:
        return seeds.chunk(side_by_side)(schedule, state, jnp.asarray(n))

    chex.clear_trace_counter()  # it counts by a function's address, which may be reused
    traced_once = jax.jit(chex.assert_max_traces(chunk, n=1))
    return partial(traced_once, programs.schedule(side_by_side.config))


def _lane(found: tuple[TrainState, dict], lane: int) -> Leaves:
    """Returns the state and the metrics of one seed, by name."""
    state, metrics = found
    leaves = to_leaves(state) | {name: np.asarray(column) for name, column in metrics.items()}
    return {name: leaf[lane] for name, leaf in leaves.items()}


def _assert_same(found: Leaves, expected: Leaves) -> None:
    assert found.keys() == expected.keys()
    for name, leaf in found.items():
        np.testing.assert_array_equal(leaf, expected[name], err_msg=name, strict=True)


@pytest.mark.slow
def test_every_seed_is_another_run(start: TrainState, run: Run) -> None:
    lanes = [_lane(run(start, UPDATES), k) for k in range(SEEDS)]
    for name in ("key", "arenas/level/start", "learners/params/actor/mean/kernel", "policy_loss"):
        assert not np.array_equal(lanes[0][name], lanes[1][name]), name
        assert not np.array_equal(lanes[1][name], lanes[2][name]), name
    assert [int(lane["update"][UPDATES - 1]) for lane in lanes] == [UPDATES - 1] * SEEDS


def test_neither_lane_nor_neighbours_matter(start: TrainState, run: Run) -> None:
    found = run(start, UPDATES)
    order = np.array([2, 0, 0])  # other positions, and another neighbour
    moved = run(jax.tree.map(lambda x: x[order], start), UPDATES)
    for lane, seed in enumerate(order):
        _assert_same(_lane(moved, lane), _lane(found, seed))


def test_a_broken_seed_leaves_the_others_alone(start: TrainState, run: Run) -> None:
    def broken(x: jax.Array) -> jax.Array:
        return x.at[1].set(np.nan)

    params = start.learners.params
    params = params | {"critic": jax.tree.map(broken, params["critic"])}
    learners = replace(start.learners, params=params)
    found, expected = run(replace(start, learners=learners), UPDATES), run(start, UPDATES)
    assert _lane(found, 1)["policy_loss"][0] == -np.inf
    for lane in (0, 2):
        _assert_same(_lane(found, lane), _lane(expected, lane))


@pytest.mark.slow
def test_a_seed_begins_alike_wherever_it_stands(
    tiny_config: TrainConfig, tiny_world: World, start: TrainState
) -> None:
    later = _start(_program(tiny_config, tiny_world, SEEDS, first=1))
    for lane in (0, 1):
        _assert_same(_lane((later, {}), lane), _lane((start, {}), lane + 1))


@pytest.mark.slow
def test_one_seed_is_what_the_loop_makes(
    tiny_config: TrainConfig, tiny_world: World, start: TrainState, run: Run
) -> None:
    program = _program(tiny_config, tiny_world, 1, first=1)
    schedule = programs.schedule(program.config)
    first = _start(program)
    plain = jax.jit(partial(loop.init, program))(schedule)
    _assert_same(_lane((first, {}), 0), to_leaves(plain))
    state, metrics = _run(program)(first, UPDATES)
    chunk = jax.jit(partial(loop.train_chunk, program))
    expected, rows = chunk(schedule, plain, UPDATES)
    _assert_same(_lane((state, metrics), 0), to_leaves(expected) | jax.device_get(rows))
    # Batched matrix products round differently from those of one seed, in the last bits of float32
    # (6e-8). The difference grows over the gradient steps of the update; 1e-5 leaves room for it.
    once, _ = chunk(schedule, plain, np.int32(1))
    beside, _ = run(start, np.int32(1))
    for name, leaf in to_leaves(once.learners.params).items():
        lane = to_leaves(beside.learners.params)[name][1]
        np.testing.assert_allclose(lane, leaf, rtol=0.0, atol=1e-5, err_msg=name)


def test_every_seed_has_a_curriculum_of_its_own(start: TrainState, run: Run) -> None:
    """Ends a cohort with made-up counts: the seeds reach all, half and none of 10 targets."""
    stages, cohort, threshold = 2, 2, 0.8
    reached = np.array([10, 5, 0], np.int32)
    counts = np.zeros((SEEDS, stages), np.int32)
    counts[:, 0] = 10
    hits = counts * 0
    hits[:, 0] = reached
    cohorts = start.curriculum.cohorts
    previous = cohorts.previous._replace(episodes=counts, targets=counts, reached=hits)
    own = replace(start.curriculum.own, turn=np.full(SEEDS, cohort, np.int32))
    late = replace(
        cohorts,
        number=np.full(SEEDS, cohort, np.int32),
        age=np.full(SEEDS, 1, np.int32),  # the second of two updates, of 8 steps each
        previous=previous,
    )
    before = replace(start.curriculum, own=own, cohorts=late)
    state, metrics = run(replace(start, curriculum=before), UPDATES)
    assert np.asarray(metrics["stage"])[:, :UPDATES].tolist() == [[0, 1], [0, 0], [0, 0]]
    np.testing.assert_array_equal(metrics["stage_success"][:, 0], np.float32([1.0, 0.5, 0.0]))
    assert [share >= threshold for share in (1.0, 0.5, 0.0)] == [True, False, False]
    assert np.asarray(state.curriculum.chosen.stage).tolist() == [1, 0, 0]


def test_what_is_stepped_together_lies_on_one_axis(
    tiny_config: TrainConfig, tiny_world: World, start: TrainState, side_by_side: Program
) -> None:
    flat = mesh.stepped_together(side_by_side, start).qpos
    held = np.asarray(start.arenas.sim.qpos)
    assert held.shape[:2] == (SEEDS, tiny_config.arenas)
    np.testing.assert_array_equal(flat, np.concatenate(list(held)))


def test_warp_has_room_for_the_arenas_that_are_stepped_together(tiny_config: TrainConfig) -> None:
    arenas = tiny_config.arenas * SEEDS
    sim = replace(tiny_config.sim, impl="warp", solver="mjx")
    warp = replace(tiny_config, sim=sim)
    several = programs.load_world(replace(warp, seeds=SEEDS)).physics.engine.template
    expected = programs.load_world(replace(warp, arenas=arenas)).physics.engine.template
    assert several._impl.naconmax == expected._impl.naconmax
    assert several._impl.naconmax >= arenas


def test_warp_has_room_for_seeds_of_one_group_on_one_core(
    tiny_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs, "cores", lambda: 1)
    sim = replace(tiny_config.sim, impl="warp", solver="mjx")
    warp = replace(tiny_config, sim=sim)
    grouped = replace(warp, seeds=SEEDS, seeds_by="cores")
    several = programs.load_world(grouped).physics.engine.template
    all_at_once = replace(warp, arenas=SEEDS * warp.arenas)
    expected = programs.load_world(all_at_once).physics.engine.template
    assert several._impl.naconmax == expected._impl.naconmax
    assert several._impl.naconmax >= SEEDS * warp.arenas


@pytest.mark.parametrize(
    ("by", "cores", "backend", "expected"),
    [("vmap", 2, "cpu", 6), ("cores", 1, "cpu", 6), ("cores", 2, "cpu", 3),
     ("cores", 4, "cpu", 2), ("cores", 16, "cpu", 1), ("cores", 2, "gpu", 6)],
)  # fmt: skip
def test_a_call_steps_the_seeds_of_a_group_side_by_side(
    by: Literal["vmap", "cores"], cores: int, backend: str, expected: int,
    tiny_config: TrainConfig, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(programs, "cores", lambda: cores)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert programs.side_by_side(replace(tiny_config, seeds=6, seeds_by=by)) == expected


def test_networks_know_how_many_learners_train_side_by_side(tiny_config: TrainConfig) -> None:
    algo = replace(tiny_config.algo, policy="independent")  # one for each of three robots
    config = replace(tiny_config, seeds=6, algo=algo)
    assert programs.load(config)[0].ppo.learning.side_by_side == 18


def test_numbers_count_up_from_the_seed(tiny_config: TrainConfig) -> None:
    assert list(replace(tiny_config, seed=7, seeds=3).numbers) == [7, 8, 9]


def test_warp_steps_the_arenas_of_all_seeds_each_with_its_own_model(
    tiny_config: TrainConfig,
) -> None:
    """Drives a robot against a box whose size, a number of the model, differs by arena."""
    lanes, arenas, steps = 3, 2, 40
    sim = replace(tiny_config.sim, impl="warp")
    engine = programs.load_world(replace(tiny_config, sim=sim, seeds=lanes, arenas=arenas)).physics
    half = np.linspace(0.02, 0.05, lanes * arenas, dtype=np.float32)
    obstacle = np.zeros((lanes * arenas, 2, 5), np.float32)
    obstacle[:, 0] = [0.0, 0.1, 0.0, 0.05, 0.0]
    obstacle[:, 0, 4] = half
    obstacle[:, 1] = [5.0, 5.0, 0.0, 0.05, 0.05]  # parked
    pose = np.array([[x, -0.1, np.pi / 2] for x in (-0.2, 0.0, 0.2)], np.float32)
    wheels = jnp.full((3, 2), 6.0)  # 3.9 mm a control step, 16 cm in all

    def drive(obstacle: jax.Array) -> jax.Array:
        def step(_: int, data: Any) -> Any:
            return physics.step(engine, data, jnp.float32(0.8), obstacle, wheels)

        data = physics.unpack(engine, physics.rest(engine, pose))
        return physics.poses(engine, jax.lax.fori_loop(0, steps, step, data))

    found = jax.jit(jax.vmap(jax.vmap(drive)))(obstacle.reshape(lanes, arenas, 2, 5))
    met = 0.1 - half - tiny_config.robot.hull_radius
    # A robot that pushes against a box sinks in by at most 4 mm.
    np.testing.assert_allclose(np.ravel(found[:, :, 1, 1]), met, rtol=0.0, atol=4e-3)
    np.testing.assert_array_equal(found.reshape(-1, 3, 3), jax.jit(jax.vmap(drive))(obstacle))


@pytest.mark.parametrize(
    ("count", "cores", "by", "expected"),
    [(10, 2, "cores", 2), (10, 4, "cores", 2), (10, 16, "cores", 10), (7, 4, "cores", 1),
     (1, 8, "cores", 1), (10, 2, "vmap", 1)],
)  # fmt: skip
def test_cores_have_as_many_seeds_each(
    count: int, cores: int, by: Literal["vmap", "cores"], expected: int,
    tiny_config: TrainConfig,
) -> None:  # fmt: skip
    assert programs.groups(replace(tiny_config, seeds=count, seeds_by=by), cores) == expected


def test_groups_of_seeds_are_cut_and_joined_in_order() -> None:
    lanes = {"a": np.arange(6), "key": jax.random.split(jax.random.key(0), 6)}
    parts = seeds.split(lanes, 3)
    assert [part["a"].tolist() for part in parts] == [[0, 1], [2, 3], [4, 5]]
    joined = seeds.join(parts)
    assert joined["a"].tolist() == list(range(6))
    assert (joined["key"] == lanes["key"]).all()
