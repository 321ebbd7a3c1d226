"""The published experiment, with verdicts."""
