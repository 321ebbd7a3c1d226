"""Draws a batch of 6,000 steps and initial weights, from NumPy's generator alone.

The program that made the golden numbers and the update that is compared with them both use these
inputs, in float64.
"""

import itertools
from typing import NamedTuple

import numpy as np

STEPS, OBSERVATION, ACTION, HIDDEN = 6000, 10, 2, 64
STD = 0.6
ARRIVALS = (350, 1210, 2399, 3050, 5200)  # steps in which a robot arrives and its episode ends
TIME_OUTS = (1849, 4549)  # steps at which the step limit ends an episode; the last is cut at 6,000


class Inputs(NamedTuple):
    """The inputs of an update; `layers` lists (kernel [in, out], bias [out]) for each network."""

    observation: np.ndarray
    noise: np.ndarray
    reward: np.ndarray
    layers: dict[str, list[tuple[np.ndarray, np.ndarray]]]


def draw() -> Inputs:
    """Draws all inputs; weights follow PyTorch's default initialisation, U(+-1 / sqrt(inputs))."""
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
    """Returns a mask of the given steps, [6000] bool."""
    return np.isin(np.arange(STEPS), steps)
