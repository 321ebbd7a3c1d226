"""Checks that pictures of the gallery show robots, targets and boxes where they are."""

import numpy as np
import pytest
from PIL import Image

from benchmarks.gallery import SIZE, GalleryConfig, Moment, picture
from swarmjax.config import ConfigError
from swarmjax.task.level import Level

SIDE = 1.0  # m; the picture shows 0.03 m more on each side
BLUE, BLACK, WHITE = (31, 119, 180), (0, 0, 0), (255, 255, 255)
_LEVEL = Level(
    side=np.float32(SIDE),
    present=np.array([True, False]),
    start=np.array([[0.2, 0.1, 0.0], [5.0, 5.0, 0.0]]),
    target=np.array([[-0.3, -0.3], [5.0, 5.0]]),
    obstacle=np.array([[-0.2, 0.3, 0.0, 0.1, 0.02], [0.4, 0.4, 0.0, 0.1, 0.1]]),
    obstacle_present=np.array([True, False]),
    seed=np.uint32(0),
)


def _at(image: Image.Image, x: float, y: float) -> tuple[int, int, int]:
    """Reads the colour at a place (m, y up), rounded to blue, black or white if close to one.

    Scaling the image down changes colours beside an edge by a few of 255 shades. The three colours
    are 100 or more shades apart.
    """
    found = _shade(image, x, y)
    near = [c for c in (BLUE, BLACK, WHITE) if max(np.abs(np.subtract(c, found))) < 30]
    return near[0] if near else found


def _shade(image: Image.Image, x: float, y: float) -> tuple[int, int, int]:
    pixel = SIZE / (SIDE + 0.06)
    found = image.getpixel((round(0.5 * SIZE + x * pixel), round(0.5 * SIZE - y * pixel)))
    assert isinstance(found, tuple)
    red, green, blue = found
    return int(red), int(green), int(blue)


def _picture(arrived: bool) -> Image.Image:
    pose = np.array([[0.2, 0.1, 0.0], [5.0, 5.0, 0.0]])
    return picture(_LEVEL, Moment(pose, np.array([arrived, False])))


def test_a_robot_is_a_disc_around_its_place() -> None:
    image = _picture(arrived=False)
    assert _at(image, 0.2 - 0.02, 0.1) == BLUE
    assert _at(image, 0.2 - 0.05, 0.1) == WHITE


def test_a_target_is_a_circle_of_the_zone_of_arrival() -> None:
    image = _picture(arrived=False)
    assert _at(image, -0.3, -0.3) == WHITE
    row = [_at(image, -0.3 + reach, -0.3) for reach in np.linspace(0.042, 0.052, 9)]
    assert min(red for red, _, _ in row) < 128


def test_a_robot_that_has_arrived_has_a_white_dot() -> None:
    assert _at(_picture(arrived=True), 0.2 - 0.01, 0.1) == WHITE
    assert _at(_picture(arrived=False), 0.2 - 0.01, 0.1) == BLUE


def test_only_boxes_that_are_there_are_drawn() -> None:
    image = _picture(arrived=False)
    assert _at(image, -0.29, 0.3) == BLACK
    assert _at(image, 0.4, 0.4) == WHITE


def test_a_baseline_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ConfigError, match="who is 'trap:nobody': give CELL:NAME"):
        GalleryConfig(out="pictures", policy="policy.npz", who=("trap:nobody",))
