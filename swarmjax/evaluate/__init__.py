"""Evaluates policies on levels that they never trained on, in an engine that did not train them.

It imports `task`, `sim` and policy files, and no JAX. Two modules import more: `engine_mjx.py` runs
episodes on the device and imports `training` too, and `trials.py` stores its programs in `run`'s
cache. `cells.py` draws or reads the levels, `trials.py` runs the episodes, and `measures.py` and
`statistics.py` compute the metrics. Start with `evaluation.evaluate`.
"""
