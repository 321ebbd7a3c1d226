"""E-puck swarms in MuJoCo MJX: thousands of arenas, a curriculum and PPO in one compiled program.

Python code calls `make_env`, `train_policy`, `evaluate_policy` and `load_policy`. They raise
`SwarmjaxError` for what they refuse. Importing this package imports neither JAX nor NumPy.

Every docstring uses these axes: `T` time, `A` arenas, `R` robots (max), `K` infrared sensors,
`O` observation, `U` = 2 command, `M` obstacles (max), `S` stages, `L` learners (1 when the policy
is shared, R when every robot has its own). Units are SI. Angles are in radians and
counter-clockwise, and x points forward. A step is always qualified: a physics step, a control step
(one per arena), a robot step (a control step of one robot), a transition (a robot step that was
trained on).
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
