"""The compiled side of a run: one program that drives, learns and decides, n times over.

Imports `task`, `sim`, `ppo` and `curriculum`. `config.py` has what fixes the program, `program.py`
builds it, `rollout.py` drives the arenas, `loop.py` joins it all, `seeds.py` runs several at once.
Start with `loop.update`.
"""
