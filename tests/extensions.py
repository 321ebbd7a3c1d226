"""Files with pieces of somebody's own, for the tests of all who take them."""

from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
OWN = EXAMPLES / "own_pieces.py"
RING = EXAMPLES / "ring.yaml"

HEAD = """
import jax
import jax.numpy as jnp
from flax import linen as nn
from swarmjax.extension import level_drawing, network, observation, reward_term
"""


def write(path: Path, body: str) -> str:
    """Writes a file of pieces and returns its path as a word."""
    path.write_text(HEAD + body)
    return str(path)
