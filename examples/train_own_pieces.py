"""Trains with your own pieces and evaluates the policy: python train_own_pieces.py."""

import sys
from pathlib import Path

import own_pieces

import swarmjax

HERE = Path(__file__).parent
BUDGET = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000


def report(row: dict) -> bool:
    """Prints the return of every tenth update; stops at 99.9 % of the targets."""
    if row["update"] % 10 == 0 and row["return"] is not None:
        print(f"update {row['update']}: return {row['return']:.3f}")  # noqa: T201
    return (row["stage_success"] or 0.0) > 0.999


result = swarmjax.train_policy(
    {"stage": HERE / "ring.yaml", "budget": BUDGET, "arenas": 64},
    on_update=report,
    extensions=own_pieces,
)
found = swarmjax.evaluate_policy(result.policy, extensions=own_pieces, episodes=20)
targets = found["cells"][0]["measures"]["targets_reached"]["mean"]
print(f"{result.run}: {100 * targets:.1f} % of the targets on {found['cells'][0]['cell']}")  # noqa: T201
