"""A policy as a controller for e-pucks in Webots, a folder that needs only NumPy.

The controller is `webots_controller.py` as it stands, told to import the `policy.py` beside it.
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
        content: of its file.
        answers: whose sensors it is to read: those of simulated e-pucks, or of real ones.
        name: of the controller and its folder, which Webots wants to be the same.

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
    """Says in numbers what the counts of infrared sensors mean.

    Args:
        answers: whose sensors they are.

    Returns:
        `answers`; `distance` (m) and `counts`, the points of Webots' table, with lines in between;
        and for real sensors `fit`, where a count n above free space, at most `span` [K], means
        sqrt(`strength` / n) - `depth` + `to_hull` [K] m, between 0 and `reach`.
    """
    counts = np.array([row[1] for row in epuck.INFRARED_TABLE])
    found: dict[str, Any] = {
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
        found["fit"] = {key: value.tolist() for key, value in fit.items()}
        found["fit"]["reach"] = response.REACH["real"]
    return found


def _about(trained: Policy, answers: Literal["webots", "real"], name: str) -> dict[str, str]:
    """What the README says of a policy."""
    meta = trained.meta
    robot, task = meta["robot"], meta["task"]
    learners = len(trained.mean)
    each = (
        f"   - of the {learners} policies each robot takes its own: add `robot=0` to "
        f"`robot={learners - 1}`.\n"
    )
    stops = f"A robot stops at {task['target_radius']:g} m from its target."
    stays = "A robot drives on at its target: the policy is trained to stay there by itself."
    who = {
        "webots": "the sensors that Webots simulates",
        "real": "the sensors of real e-pucks, zeroed to read 0 in free space",
    }
    return {
        "name": name,
        "digest": trained.digest,
        "period": f"{1000 * task['control_step']:g}",
        "robots": "" if trained.is_shared else each,
        "arrival": stays if layout.holds(trained) else stops,
        "trained": layout.trained_as(trained),
        "observes": f"encoding `{trained.encoding}`, infrared up to {meta['sensors']['range']:g} m",
        "answers": who[answers],
        "max_wheel_speed": f"{robot['max_wheel_speed']:g}",
        "observation": layout.table(trained),
    }
