"""Extension files with custom pieces, for tests of the code that loads them."""

from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
OWN = EXAMPLES / "own_pieces.py"
RING = EXAMPLES / "ring.yaml"

HEAD = """
import jax
import jax.numpy as jnp
from flax import linen as nn
from swarmjax.extension import curriculum, level_drawing, network, observation, reward_term
"""


def write(path: Path, body: str) -> str:
    """Writes an extension file with this body and returns its path as a string."""
    path.write_text(HEAD + body)
    return str(path)
