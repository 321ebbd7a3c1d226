"""Errors that the user can fix. Commands can import them without loading JAX."""


class CheckpointError(ValueError):
    """Says in one sentence that a checkpoint is missing, damaged or from another run."""


class TrainingError(RuntimeError):
    """Says in one sentence why a run cannot continue."""


class LostPeerError(RuntimeError):
    """Says in one sentence that another process of the run is gone."""
