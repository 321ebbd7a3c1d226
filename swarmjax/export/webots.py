"""Makes a Webots e-puck controller from a policy: a folder that needs only NumPy.

The controller is a copy of `webots_controller.py` that imports the `policy.py` in its own folder.
"""

import json
from pathlib import Path
from string import Template

import numpy as np

from swarmjax import epuck, policy
from swarmjax.export import layout, webots_controller
from swarmjax.policy import Policy
from swarmjax.sim import response

_TEMPLATE = Path(__file__).resolve().parent / "templates" / "webots" / "README.md"
_IMPORTS = "from swarmjax import policy\nfrom swarmjax.policy import Policy\n"


def render(trained: Policy, content: bytes, name: str) -> dict[str, bytes]:
    """Makes the files of a controller.

    Args:
      trained: the policy.
      content: content of the policy file.
      name: name of the controller and of its folder. Webots requires that both have the same name.

    Returns:
      The controller, `policy.py`, `policy.npz`, `sensors.json` and `README.md`.
    """
    source = Path(webots_controller.__file__).read_text()
    texts = {
        f"{name}.py": source.replace(_IMPORTS, "import policy\nfrom policy import Policy\n"),
        "policy.py": Path(policy.__file__).read_text(),
        "sensors.json": json.dumps(sensors(), indent=2) + "\n",
        "README.md": Template(_TEMPLATE.read_text()).substitute(_about(trained, name)),
    }
    return {"policy.npz": content} | {key: text.encode() for key, text in texts.items()}


def sensors() -> dict[str, list[float]]:
    """Describes how to convert the counts of simulated infrared sensors to distances.

    Returns:
      The points of Webots' table as `distance` (m) and `counts`. Interpolate linearly between them.
    """
    counts = np.array([row[1] for row in epuck.INFRARED_TABLE])
    distance = response.distance("webots", counts, np)
    return {"distance": distance.tolist(), "counts": counts.tolist()}


def _about(trained: Policy, name: str) -> dict[str, str]:
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
    return {
        "name": name,
        "digest": trained.digest,
        "period": f"{1000 * task['control_step']:g}",
        "robots": "" if trained.is_shared else each,
        "arrival": stays if task["arrival"] == "hold" else stops,
        "trained": layout.trained_as(trained),
        "observes": f"encoding `{trained.encoding}`, infrared up to {meta['sensors']['range']:g} m",
        "max_wheel_speed": f"{robot['max_wheel_speed']:g}",
        "observation": layout.table(trained),
    }
