"""Errors that are the user's to mend, where a command can name them without loading JAX."""


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged or of another run, in one sentence."""


class TrainingError(RuntimeError):
    """A run that cannot go on, in one sentence."""


class DivergedError(RuntimeError):
    """A run that learns nothing any more, in one sentence."""


class LostPeerError(RuntimeError):
    """A process of a run whose others are gone, in one sentence."""
