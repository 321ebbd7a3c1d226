"""Proximal policy optimisation of one learner: pure functions, without an idea of what it learns.

Imports `config` alone. `learner.py` is plain PPO; `dispatch.py` is the only module that knows the
faster ways of `fast/`, and everything works without them. Start with `learner.update`.
"""
