"""The judge of policies: levels that they never trained on, and another engine than training's.

It imports `task`, `sim` and policy files, and no JAX. Two modules differ: `engine_mjx.py` judges on
the device and imports `training` and `ppo` too, and `trials.py` stores its programs in `run`'s
cache. `cells.py` draws or reads the levels, `trials.py` runs the episodes, and `measures.py` and
`statistics.py` compute the figures. Start with `evaluation.evaluate`.
"""
