"""Proximal policy optimisation of one learner: pure functions that know nothing about the task.

The only other package of this project that it imports is `config`. `ppo.py` is plain PPO. Only
`dispatch.py` uses `fast/`, which computes the same updates faster, and everything works without
`fast/`. Start with `PPO.update`.
"""
