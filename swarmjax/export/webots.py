"""Makes a Webots e-puck controller from a policy: a folder that needs only NumPy.

The controller is a copy of `webots_controller.py` that imports the `policy.py` in its own folder.
"""

import json
from pathlib import Path
from string import Template
from typing import Any, Literal

import numpy as np

from swarmjax import epuck, policy
from swarmjax.export import layout, webots_controller
from swarmjax.policy import Policy
from swarmjax.sim import response

_TEMPLATE = Path(__file__).resolve().parent / "templates" / "webots" / "README.md"
_IMPORTS = "from swarmjax import policy\nfrom swarmjax.policy import Policy\n"


def render(
    trained: Policy, content: bytes, answers: Literal["webots", "real"], name: str
) -> dict[str, bytes]:
    """Makes the files of a controller.

    Args:
      trained: the policy.
      content: content of the policy file.
      answers: whether to read the sensors of simulated or of real e-pucks.
      name: name of the controller and of its folder; Webots needs them to be equal.

    Returns:
      The controller, `policy.py`, `policy.npz`, `sensors.json` and `README.md`.
    """
    source = Path(webots_controller.__file__).read_text()
    texts = {
        f"{name}.py": source.replace(_IMPORTS, "import policy\nfrom policy import Policy\n"),
        "policy.py": Path(policy.__file__).read_text(),
        "sensors.json": json.dumps(sensors(answers), indent=2) + "\n",
        "README.md": Template(_TEMPLATE.read_text()).substitute(_about(trained, answers, name)),
    }
    return {"policy.npz": content} | {key: text.encode() for key, text in texts.items()}


def sensors(answers: Literal["webots", "real"]) -> dict[str, Any]:
    """Describes how to convert the counts of infrared sensors to distances.

    Args:
      answers: whether they are the sensors of simulated or of real e-pucks.

    Returns:
      `answers`, and the points of Webots' table as `distance` (m) and `counts`, to be
      interpolated linearly. For real sensors also `fit`: a count that is n above free space, with n
      at most `span` [K], means a distance of sqrt(`strength` / n) - `depth` + `to_hull` [K] m,
      clipped to the range from 0 to `reach`.
    """
    counts = np.array([row[1] for row in epuck.INFRARED_TABLE])
    curve: dict[str, Any] = {
        "answers": answers,
        "distance": response.distance("webots", counts, np).tolist(),
        "counts": counts.tolist(),
    }
    if answers == "real":
        strength, depth, free, _, saturation = np.array(epuck.INFRARED_FIT).T
        fit = {
            "strength": strength,
            "depth": depth,
            "span": saturation - free,
            "to_hull": response.TO_HULL,
        }
        curve["fit"] = {key: value.tolist() for key, value in fit.items()}
        curve["fit"]["reach"] = response.REACH["real"]
    return curve


def _about(trained: Policy, answers: Literal["webots", "real"], name: str) -> dict[str, str]:
    """Returns the README's texts about a policy."""
    meta = trained.meta
    robot, task = meta["robot"], meta["task"]
    learners = len(trained.mean)
    each = (
        f"   - one of the {learners} policies for each robot: add `robot=0` to "
        f"`robot={learners - 1}`.\n"
    )
    stops = f"A robot stops at {task['target_radius']:g} m from its target."
    stays = "A robot keeps driving at its target: the policy is trained to stay there by itself."
    who = {
        "webots": "the sensors that Webots simulates",
        "real": "the sensors of real e-pucks, zeroed to read 0 in free space",
    }
    return {
        "name": name,
        "digest": trained.digest,
        "period": f"{1000 * task['control_step']:g}",
        "robots": "" if trained.is_shared else each,
        "arrival": stays if task["arrival"] == "hold" else stops,
        "trained": layout.trained_as(trained),
        "observes": f"encoding `{trained.encoding}`, infrared up to {meta['sensors']['range']:g} m",
        "answers": who[answers],
        "max_wheel_speed": f"{robot['max_wheel_speed']:g}",
        "observation": layout.table(trained),
    }
