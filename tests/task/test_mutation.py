"""Tests mutated levels, which are drawn as usual after one of their numbers has changed."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.config import ConfigError, build
from swarmjax.curriculum import levels
from swarmjax.run.load_settings import load_train
from swarmjax.sim import gaps
from swarmjax.task import level, mutation
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.stage_config import StageConfig, complete

HULL, REACH = 0.037, 0.05  # m; radii of an e-puck and its zone of arrival
STAGES = [
    "world_trap",
    "world_fence",
    "world_bay",
    "world_row",
    "world_door",
    "world_maze",
    "world_clutter",
    "world_circle",
    "world_crowd20",
    "world_dense",
    "s6",
]
# NumPy takes a few milliseconds to draw a mutated level. The fast tests draw 30 levels of each
# stage, and the slow tests 240, which is 2,640 in all.
PARENTS, GENERATIONS = 30, [1, pytest.param(8, marks=pytest.mark.slow)]
MUTATE = jax.jit(jax.vmap(levels.mutate, in_axes=(0, None, 0)))


def _stage(name: str) -> StageConfig:
    return load_train([f"stage={name}"]).stage[0]


def _spacing(stage: StageConfig) -> Spacing:
    # Two more robots and obstacles are compiled in than take part.
    return Spacing(stage.robots + 2, stage.obstacles + 2, HULL, REACH)


def _numbers(stage: StageConfig, count: int) -> np.ndarray:
    """Returns the numbers of drawn levels, written out."""
    spacing = _spacing(stage)
    size = (count, level.uniform_count(spacing))
    uniforms = np.random.default_rng(7).random(size, dtype=np.float32)
    added = mutation.layout_count([stage], spacing.robots)
    return np.array([level.write_out(each, spacing, added, np) for each in uniforms])


@functools.cache
def _family(name: str, generations: int) -> list[tuple[Level, Level]]:
    """Returns mutated levels, each with the level from which it was mutated."""
    stage = _stage(name)
    arrays, spacing = task_stage.single(stage), _spacing(stage)
    numbers, movable = _numbers(stage, PARENTS), mutation.movable([stage], spacing)[0]
    found, random = [], np.random.default_rng(8)
    parents = [level.sample(each, arrays, spacing, np) for each in numbers]
    for _ in range(generations):
        picks = random.random((PARENTS, 2), dtype=np.float32)
        numbers = np.asarray(MUTATE(numbers, movable, picks))
        children = [level.sample(each, arrays, spacing, np) for each in numbers]
        found += zip(children, parents, strict=True)
        parents = children
    return found


def _least(places: np.ndarray) -> float:
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return float(apart[~np.eye(len(places), dtype=bool)].min(initial=np.inf))


@pytest.mark.parametrize("generations", GENERATIONS)
@pytest.mark.parametrize("name", STAGES)
def test_nothing_of_a_mutated_level_overlaps(name: str, generations: int) -> None:
    for drawn, _ in _family(name, generations):
        start, target = drawn.start[drawn.present], drawn.target[drawn.present]
        assert len(start) == _stage(name).robots
        assert min(_least(start[:, :2]), _least(target)) >= 2.0 * HULL
        # Robots keep a gap to walls and boxes, both at their starts and on their targets.
        for pose in (start, np.concatenate([target, 0.0 * target[:, :1]], axis=-1)):
            gap = gaps.gaps(pose, drawn.side, drawn.obstacle, HULL, np)
            assert gap.min() > 0.0
        assert np.linalg.norm(start[:, :2] - target, axis=-1).min() > REACH


@pytest.mark.parametrize("name", STAGES)
def test_a_mutation_changes_the_level_and_keeps_its_seed(name: str) -> None:
    same, family = 0, _family(name, 1)
    for drawn, parent in family:
        fields = zip(drawn, parent, strict=True)
        same += all(np.array_equal(one, other) for one, other in fields)
        assert drawn.seed == parent.seed
    # A changed number may round to the same place. In a maze, two of three changes have no effect:
    # they concern the number of an empty room, or of a wall that is present either way.
    assert same / len(family) < (0.9 if name == "world_maze" else 0.25)


@pytest.mark.parametrize("name", STAGES)
def test_numbers_written_out_draw_the_same_level_to_the_last_bit(name: str) -> None:
    stage = _stage(name)
    arrays, spacing = task_stage.single(stage), _spacing(stage)
    for numbers in _numbers(stage, 10):
        uniforms = numbers[: level.uniform_count(spacing)]
        for found, expected in zip(
            level.sample(numbers, arrays, spacing, np),
            level.sample(uniforms, arrays, spacing, np),
            strict=True,
        ):
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", ["world_door", "s6"])
def test_jax_and_numpy_draw_the_same_mutated_level(name: str) -> None:
    stage = _stage(name)
    arrays, spacing = task_stage.single(stage), _spacing(stage)
    picks = np.random.default_rng(9).random((10, 2), dtype=np.float32)
    movable = mutation.movable([stage], spacing)[0]
    numbers = np.asarray(MUTATE(_numbers(stage, 10), movable, picks))
    ours = jax.tree.map(jnp.asarray, arrays)
    drawn = jax.jit(jax.vmap(lambda each: level.sample(each, ours, spacing, jnp)))(numbers)
    for i, each in enumerate(numbers):
        expected = level.sample(each, arrays, spacing, np)
        for key in ("start", "target", "obstacle_present"):
            found = getattr(drawn, key)[i]
            np.testing.assert_array_equal(found, getattr(expected, key), err_msg=key)


def _refusal(stage: StageConfig) -> str:
    with pytest.raises(ConfigError) as error:
        mutation.check(stage)
    return str(error.value)


def test_what_has_nothing_to_move_is_refused() -> None:
    fence = _stage("fence")
    assert _refusal(fence) == (
        "curriculum.levels.mutation is given, but stage fence has level=fixed, which is always "
        "the same and has nothing to move: give mutation=0, or leave the stage out."
    )
    assert "drawn by an extension" in _refusal(replace(_stage("s6"), level="spiral"))
    rows = ("#####", "#aA.#", "#...#", "#####")
    assert "gives every robot its place" in _refusal(_mapped(rows, robots=1))


def test_robots_of_a_map_that_have_letters_stay_where_they_are() -> None:
    stage = _mapped(("######", "#aASS#", "#..TT#", "#....#", "######"), robots=3)
    spacing = Spacing(3, stage.obstacles, HULL, REACH)
    found = mutation.movable([stage], spacing)[0]
    first = 6 + 2 * stage.obstacles
    # The movable numbers are the targets of the second and third robot, then their starts.
    np.testing.assert_array_equal(np.flatnonzero(found), first + np.array([1, 2, 4, 5]))


def _mapped(rows: tuple[str, ...], robots: int) -> StageConfig:
    given = {"name": "mapped", "robots": robots, "map": list(rows), "cell": 0.2}
    return build(StageConfig, complete(given))
