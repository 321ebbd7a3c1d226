"""Proximal policy optimisation of one learner: pure functions that know nothing about the task.

Of this project it imports only `config`. `ppo.py` is plain PPO. `dispatch.py` alone knows the
faster ways of `fast/`, and everything works without them. Start with `PPO.update`.
"""
