"""The curriculum: which stage each arena trains on, and when that changes.

It imports `task` for stages and for ended episodes. `engine.py` counts and judges episodes, and
calls a mode. `modes.py` has one pure function for each mode. `log.py` writes decisions as log
entries. Start with `engine.advance`.
"""
