"""A batch of 6,000 steps and the weights that meet it, from NumPy's generator alone.

What made the golden numbers and what is held against them both read it, in float64.
"""

import itertools
from typing import NamedTuple

import numpy as np

STEPS, OBSERVATION, ACTION, HIDDEN = 6000, 10, 2, 64
STD = 0.6
ARRIVALS = (350, 1210, 2399, 3050, 5200)  # steps that end an episode at its target
TIME_OUTS = (1849, 4549)  # steps at which the step limit does; the last episode is cut at 6,000


class Inputs(NamedTuple):
    """What an update learns from, and `layers` by network: (kernel [in, out], bias [out])."""

    observation: np.ndarray
    noise: np.ndarray
    reward: np.ndarray
    layers: dict[str, list[tuple[np.ndarray, np.ndarray]]]


def draw() -> Inputs:
    """Draws everything; PyTorch's default initialisation is U(+-1 / sqrt(inputs))."""
    random = np.random.default_rng(20241105)
    layers = {}
    for network, outputs in (("actor", ACTION), ("critic", 1)):
        sizes = (OBSERVATION, HIDDEN, HIDDEN, outputs)
        layers[network] = [
            (random.uniform(-1, 1, (i, o)) / np.sqrt(i), random.uniform(-1, 1, o) / np.sqrt(i))
            for i, o in itertools.pairwise(sizes)
        ]
    return Inputs(
        observation=random.uniform(0, 1, (STEPS, OBSERVATION)),
        noise=random.standard_normal((STEPS, ACTION)),
        reward=random.normal(0.001, 0.003, STEPS),
        layers=layers,
    )


def ends(steps: tuple[int, ...]) -> np.ndarray:
    """Marks steps, [6000] bool."""
    return np.isin(np.arange(STEPS), steps)
