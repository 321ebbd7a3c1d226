"""Policies judged on levels that they never saw, by another engine than the one that trains.

Imports `task`, `sim` and policy files, and no JAX: only `engine_mjx.py`, which judges on the
device, takes `training` and `ppo` too, and `trials.py` keeps its programs in `run`'s cache.
`cells.py` says which levels, `trials.py` runs the episodes, `measures.py` and `statistics.py` say
what came of them. Start with `evaluation.evaluate`.
"""
