"""E-puck swarms in MJX or an own contact solver: a curriculum and PPO in one compiled program.

Python code calls `make_env`, `train_policy`, `evaluate_policy` and `load_policy`. These functions
raise `SwarmjaxError` if an argument is invalid or a run breaks. Importing this package imports
neither JAX nor NumPy.

Every docstring uses these axes: `T` time, `A` arenas, `R` robots (the most in an arena), `K`
infrared sensors, `O` observation entries, `U` = 2 entries of an action or command, `M` obstacles
(the most in an arena), `S` stages, `L` learners (1 if all robots share the policy, R if every robot
has its own). Units are SI. Angles are in radians and counter-clockwise, and x points forward. There
are several kinds of steps: a physics step; a control step, which moves all robots of an arena; a
robot step, which is a control step of one robot; and a transition, which is a robot step that was
trained on.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from swarmjax.api import (
        SwarmjaxError,
        TrainResult,
        evaluate_policy,
        load_policy,
        make_env,
        train_policy,
    )

__version__ = "0.1.0"
__all__ = [
    "SwarmjaxError",
    "TrainResult",
    "__version__",
    "evaluate_policy",
    "load_policy",
    "make_env",
    "train_policy",
]


def __getattr__(name: str) -> Any:
    """Imports a name when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'swarmjax' has no attribute {name!r}")
    from swarmjax import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return __all__
