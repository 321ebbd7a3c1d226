"""Tests worlds with walls in both judges: rays that hit walls, and walls of different sizes."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import steering
from steering import STEER

from swarmjax import policy
from swarmjax.evaluate import cells, engine_c, rays
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.judge import Judge
from swarmjax.evaluate.suite_config import read_suite
from swarmjax.sim import infrared
from swarmjax.sim.config import RobotConfig
from swarmjax.task import level, stage_files
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig

RANGE, HULL = 0.04, 0.037  # m


def _judge(tmp_path: Path, stage: StageConfig, **rest: int) -> Judge:
    path = steering.write(tmp_path / "policy.npz", STEER)
    config = EvaluateConfig(policy=str(path), stage=stage, robot=RobotConfig(), **rest)
    return engine_c.load(config, policy.load(path))


def _stage(name: str) -> StageConfig:
    return stage_files.load_levels(EvaluateConfig, ["policy=none", f"stage=world_{name}"]).stage


def _levels(stage: StageConfig, count: int) -> list[Level]:
    arrays = task_stage.single(stage)
    spacing = level.Spacing(stage.robots, stage.obstacles, HULL, 0.05)
    return [engine_c.draw_level(arrays, spacing, 3, number) for number in range(count)]


@pytest.mark.parametrize(
    "name", [*(pytest.param(each, marks=pytest.mark.slow) for each in ("trap", "door")), "maze"]
)
def test_rays_meet_walls_where_mujoco_meets_them(tmp_path: Path, name: str) -> None:
    stage = _stage(name)
    judge = _judge(tmp_path, stage)
    random = np.random.default_rng(0)
    levels = [_beside_walls(each, random) for each in _levels(stage, 40)]
    arenas = engine_c.start(judge, levels)
    seen, _ = rays.cast_rays(judge.scene, arenas.data, arenas.pose, arenas.obstacle)
    stacked = [np.stack(each) for each in zip(*levels, strict=True)]
    drawn = Level(*stacked)
    found = infrared.distances(drawn.start, drawn.side, drawn.obstacle, HULL, RANGE, jnp)
    assert ((seen > 0.0) & (seen < RANGE)).sum() > 50
    # Float32 rounds positions of up to 0.8 m to 6e-8 m, and a slanted ray magnifies this error.
    np.testing.assert_allclose(found, seen, rtol=0, atol=1e-6)


def _beside_walls(drawn: Level, random: np.random.Generator) -> Level:
    """Moves robots beside long faces of walls, within range of their rays, where there is room."""
    boxes = drawn.obstacle[drawn.obstacle_present]
    start = drawn.start.copy()
    for robot in range(len(start)):
        box = boxes[random.integers(len(boxes))]
        thin = int(np.argmin(box[3:]))
        away = random.choice([-1.0, 1.0]) * (box[3 + thin] + HULL + random.uniform(0.001, 0.03))
        place = np.empty(2)
        place[thin] = box[thin] + away
        place[1 - thin] = box[1 - thin] + random.uniform(-1, 1) * box[4 - thin]
        to_boxes = np.maximum(np.abs(place - boxes[:, :2]) - boxes[:, 3:], 0.0)
        others = np.delete(start[:, :2], robot, axis=0)
        apart = np.linalg.norm(others - place, axis=-1).min(initial=np.inf)
        inside = np.abs(place).max() < 0.5 * drawn.side - HULL
        if inside and apart > 2 * HULL and np.linalg.norm(to_boxes, axis=-1).min() > HULL:
            start[robot] = [*place, random.uniform(-np.pi, np.pi)]
    return drawn._replace(start=start)


def test_levels_with_walls_of_other_sizes_go_as_they_do_alone(tmp_path: Path) -> None:
    stage = _stage("trap")
    judge = _judge(tmp_path, stage, steps=150)
    levels = _levels(stage, 4)
    halves = np.array([each.obstacle[:, 3:] for each in levels])
    assert len(np.unique(halves[:, 1].max(axis=-1))) == 4
    together = engine_c.simulate(judge, levels)
    for number, drawn in enumerate(levels):
        alone = engine_c.simulate(judge, [drawn])
        for mine, theirs in zip(alone, together, strict=True):
            np.testing.assert_array_equal(mine[0], theirs[number])
    assert together.contacts.sum() > 0


def test_a_straight_line_is_caught_in_every_trap(tmp_path: Path) -> None:
    stage = _stage("trap")
    judge = _judge(tmp_path, stage, steps=500)
    outcome = engine_c.simulate(judge, _levels(stage, 10))
    assert not outcome.arrived.any()


@pytest.mark.parametrize("name", ["worlds", "worlds_far"])
def test_a_suite_of_worlds_has_the_ten_families(name: str) -> None:
    families = "trap fence bay row door maze clutter circle crowd dense"
    found = read_suite(name).cells
    assert [cell.name for cell in found] == families.split()


def test_worlds_far_go_beyond_what_stage_files_train_on() -> None:
    for cell in read_suite("worlds_far").cells:
        trained, far = _stage(cell.name), cell.stage
        keys = ("gap", "width", "depth", "length", "apart", "side", "robots", "obstacles", "cells")
        pairs = [(getattr(trained, key), getattr(far, key)) for key in keys]
        assert any(_is_beyond(one, other) for one, other in pairs if other is not None)


def _is_beyond(trained: object, far: object) -> bool:
    low, high = trained if isinstance(trained, tuple) else (trained, trained)
    assert isinstance(low, int | float)
    assert isinstance(high, int | float)
    assert isinstance(far, int | float)
    return not low <= far <= high


def test_the_largest_half_edges_of_a_cell_bound_those_of_its_first_level() -> None:
    (cell,) = [each for each in read_suite("worlds").cells if each.name == "door"]
    drawn = cells.draw_cell(cell)
    assert drawn.largest_half.shape == (cell.stage.obstacles, 2)
    assert (drawn.largest_half >= drawn.half).all()
