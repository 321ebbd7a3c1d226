"""The host side of a run: the run directory, its checkpoints, what is shown."""
