"""Proximal policy optimisation of one learner: pure functions that know nothing about the task.

Of this project's other packages, `ppo` imports only `config`. `ppo.py` is plain PPO. Only
`dispatch.py` uses `fast/`, which computes the same updates faster, and everything works without
`fast/`. Start with `PPO.update`.
"""
