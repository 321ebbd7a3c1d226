"""The compiled side of a run: rollouts, the training loop, seeds."""
