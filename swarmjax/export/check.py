"""Checks that a form can express a policy, before anything is written."""

from collections.abc import Mapping
from typing import Any

from swarmjax import epuck
from swarmjax.config import ConfigError, show
from swarmjax.export import webots_controller
from swarmjax.policy import PolicyError
from swarmjax.sim import response


def expressible(meta: Mapping[str, Any], form: str, sensors: str) -> None:
    """Checks that a form can hold a policy and that its controller can measure all inputs.

    Args:
      meta: metadata of the policy.
      form: `onnx`, `c` or `webots`.
      sensors: sensors that the controller reads: `webots` or `real`.

    Raises:
      PolicyError: if the policy's network is code, or e-pucks cannot measure its inputs.
      ConfigError: if the policy's infrared reaches further than the sensors.
    """
    if "network" in meta:
        raise PolicyError(
            f"format is {form}, but the policy's network is {show(meta['network'])}, code of an "
            "extension that only npz supports: give format=npz, or train with algo.network=mlp."
        )
    if form != "webots":
        return
    if "neighbours" in meta["observation"]:
        raise PolicyError(
            "format is webots, but the policy observes neighbours, and the controller has no "
            "board for range and bearing: give format=c or onnx, and your own controller."
        )
    known = webots_controller.QUANTITIES
    unknown = [name for name in meta["observation"]["names"] if name not in known]
    if unknown:
        raise PolicyError(
            f"format is webots, but the policy observes {', '.join(unknown)}, which the controller "
            "cannot measure: give format=c or onnx, and your own controller."
        )
    _check_range(meta, sensors)


def _check_range(meta: Mapping[str, Any], sensors: str) -> None:
    """Checks that the policy's infrared reaches no further than the sensors measure distances."""
    reach, farthest = meta["sensors"]["range"], response.REACH[sensors]
    if meta["observation"]["encoding"] == "metric" and reach > farthest:
        raise ConfigError(
            f"format is webots, but the policy was trained with infrared to {reach:g} m, and "
            f"sensors={sensors} measure distances only to {farthest:g} m: train with "
            f"task.sensor_range={epuck.SENSOR_RANGE:g}, or give format=c or onnx."
        )
