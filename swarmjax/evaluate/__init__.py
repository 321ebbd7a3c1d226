"""Evaluates policies on levels and in an engine in which they were not trained.

The package imports `task`, `sim` and policy files, and no JAX. Two modules import more:
`engine_mjx.py` evaluates on the device and imports `training` too, and `trials.py` stores its
programs in `run`'s cache. `cells.py` draws or reads the levels, `trials.py` runs the episodes, and
`measures.py` and `statistics.py` compute the metrics. Start reading at `evaluation.evaluate`.
"""
