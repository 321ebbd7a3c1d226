"""The curriculum: which stage each arena trains on, and when that changes.

The package imports `task` for stages and for ended episodes. `engine.py` defines the protocol of a
curriculum, counts ended episodes and measures success. `stages.py` has one pure function for each
mode. `log.py` writes decisions as log entries. Start with `engine.observe`.
"""
