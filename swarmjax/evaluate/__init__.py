"""Judges policies on levels that they never saw."""
