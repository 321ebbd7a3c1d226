"""Checks that every factor of realism has its own arm."""

import dataclasses

import pytest

from benchmarks import realism_cost
from swarmjax.config import ConfigError
from swarmjax.sim.realism_config import COUNTED, RealismConfig

NO_FACTOR = {"name", "stall_time", "hull_friction"}  # entries of `real` without an arm
NAMES = {item.name for item in dataclasses.fields(RealismConfig)} - NO_FACTOR


def test_arms_are_the_presets_and_each_factor_alone() -> None:
    arms = realism_cost.arms()
    assert set(arms) == NAMES | {"real", "webots"}
    ideal = RealismConfig()
    for name in NAMES:
        on = {key for key in NAMES if getattr(arms[name], key) != getattr(ideal, key)}
        assert on - {"infrared"} == {name} - {"infrared"}
        assert ("infrared" in on) == (name in {*COUNTED, "infrared"})
        assert getattr(arms[name], name) == getattr(arms["real"], name)


def test_an_unknown_arm_is_refused() -> None:
    with pytest.raises(ConfigError, match="arms holds 'gravity': give any of real, webots"):
        realism_cost.main(["arms=mass,gravity"])
