"""Proximal policy optimisation: one learner, pure functions, nothing about robots."""
