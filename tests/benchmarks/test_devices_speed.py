"""Checks how many arenas a comparison of several devices with one uses, for each scaling."""

import pytest
from sentences import refusal

from benchmarks import devices_speed


@pytest.mark.parametrize(("scaling", "in_all"), [("weak", 256), ("strong", 128)])
def test_arenas_are_those_of_each_device_or_of_all(scaling: str, in_all: int) -> None:
    _, one, every = devices_speed.parse(["devices=2", "arenas=128", f"scaling={scaling}"])
    assert (one.devices, one.arenas) == (1, 128)
    assert (every.devices, every.arenas) == (2, in_all)


def test_one_device_is_refused() -> None:
    assert refusal(devices_speed.parse, []).startswith("devices is 1: give at least 2 ")
