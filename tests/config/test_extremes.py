"""Checks that each number given to a command is either refused or representable in float32."""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmjax.config import ConfigError, Section, build, section, to_dict
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.suite_config import SuiteFileConfig
from swarmjax.export.config import ExportConfig
from swarmjax.ppo.config import AlgoConfig
from swarmjax.replay.config import ReplayConfig
from swarmjax.report.config import ReportConfig
from swarmjax.reproduce.config import ReproduceConfig
from swarmjax.run.settings import TrainConfig
from swarmjax.watch.config import WatchConfig

STAGE = {"name": "s1", "robots": 1, "side": 1.0}
CELL = {"name": "c", "stage": STAGE, "levels": 2, "seed": 1_000_000}
COMMANDS: dict[type[Section], dict[str, Any]] = {
    TrainConfig: {"stage": [STAGE]},
    EvaluateConfig: {"policy": "a.npz", "stage": STAGE},
    ReplayConfig: {"policy": "a.npz", "stage": STAGE},
    ExportConfig: {"run": "a"},
    ReportConfig: {"run": "a"},
    WatchConfig: {"run": "a"},
    ReproduceConfig: {},
    SuiteFileConfig: {"name": "mine", "cells": [CELL]},
}
EXTREMES = [1e300, -1e300, 1e-300, -1e-300, 1e39, 1e-39, 2**31, 2**63, -(2**63), 10**5000]
# Each of these keys is valid only if another setting has the value given here.
WITH = {
    "std_decrement": {"exploration": "scheduled"},
    "std_interval": {"exploration": "scheduled"},
    "std_floor": {"exploration": "scheduled"},
    "floor": {"mode": "adaptive"},
    "infrared_noise": {"infrared": "real"},
}


def _numeric(item: dataclasses.Field[Any]) -> bool:
    return any(kind in str(item.type) for kind in ("int", "float"))


KEYS = [(cls, key) for cls in COMMANDS for key, item in section.keys(cls).items() if _numeric(item)]


def _shapes(hint: Any, value: float) -> Iterator[Any]:
    """Yield a number in each form in which a key may accept it."""
    yield value
    if "tuple" in str(hint):
        yield from ([value], [value, value], [0.5, value], [[value, value]])
    if "dict" in str(hint):
        yield {"mine": value}


def _nested(base: Any, path: list[str], value: Any) -> Any:
    """Return plain data with the value set at the path, in every item where there is a list."""
    if not path:
        return value
    if isinstance(base, list):
        return [_nested(each, path, value) for each in base]
    first, *rest = path
    found = {**base, first: _nested(base.get(first, {}), rest, value)}
    return found | (WITH.get(first, {}) if not rest else {})


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list):
        for each in value:
            yield from _numbers(each)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def _check(cls: type[Section], key: str, value: Any) -> None:
    """Check that a value is either refused in one sentence or representable in float32."""
    try:
        made = build(cls, _nested(COMMANDS[cls], key.split("."), value))
    except ConfigError as error:
        sentence = str(error)
    else:
        sentence = ""
        _check_numbers(made)
    assert "\n" not in sentence
    assert len(sentence) < 600


def _check_numbers(made: Section) -> None:
    for number in _numbers(json.loads(json.dumps(to_dict(made)))):
        kept = np.float32(number)
        assert np.isfinite(kept), number
        assert (kept == 0) == (number == 0), number


@pytest.mark.parametrize(("cls", "key"), KEYS)
def test_an_extreme_number_is_refused_or_fits_float32(cls: type[Section], key: str) -> None:
    for extreme in EXTREMES:
        for value in _shapes(section.keys(cls)[key].type, extreme):
            _check(cls, key, value)


@given(where=st.sampled_from(KEYS), number=st.floats() | st.integers())
@settings(max_examples=500, deadline=None)
def test_any_number_is_refused_or_fits_float32(
    where: tuple[type[Section], str], number: float
) -> None:
    cls, key = where
    for value in _shapes(section.keys(cls)[key].type, number):
        _check(cls, key, value)


# Only float32 bounds these keys: each is a weight, a rate or a time without a natural limit.
UNBOUNDED = {
    *(f"algo.{key}" for key in section.keys(AlgoConfig)),
    *(f"curriculum.{key}" for key in section.keys(CurriculumConfig)),
    *("run.checkpoint_minutes", "minutes"),
    "robot.sensor_poses",  # `sensors.check_poses` bounds places and yaws, each in its own unit
}


@pytest.mark.parametrize(("cls", "key"), KEYS)
def test_every_number_of_robot_task_and_sensors_has_both_ends(cls: type[Section], key: str) -> None:
    bounds = section.keys(cls)[key].metadata["bounds"]
    if key not in UNBOUNDED:
        assert np.isfinite(max(bounds.low, bounds.above)), key
        assert np.isfinite(min(bounds.high, bounds.below)), key
