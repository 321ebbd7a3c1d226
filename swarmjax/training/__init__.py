"""The compiled program of a run: rollouts, learning and curriculum, for some number of updates.

The package imports `task`, `sim`, `ppo` and `curriculum`. `config.py` has the settings that
determine the program, and `program.py` builds it. `rollout.py` drives the arenas, `loop.py` joins
all steps of an update, and `seeds.py` runs several seeds at once. Start with `loop.update`.
"""
