"""Reads, checks and writes policy files (docs/policy-format.md). Read the function `read` first.

`archive` reads and writes the files, and `fields` checks what they hold. This package imports
`config`, `policy.py`, `policy_network.py`, `extension.py` and `outputs.py`, but not JAX.
"""

from swarmjax.policy_file.archive import read, read_meta, write
from swarmjax.policy_file.fields import ACTION_NAMES, ACTION_UNITS, check

__all__ = [
    "ACTION_NAMES",
    "ACTION_UNITS",
    "check",
    "read",
    "read_meta",
    "write",
]
