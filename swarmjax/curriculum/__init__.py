"""The curriculum: which stage each arena trains on, and when that changes.

It imports `task` for stages and for ended episodes. `engine.py` has the protocol of a curriculum,
and counts and judges episodes. `stages.py` has one pure function for each mode. `log.py` writes
decisions as log entries. Start with `engine.observe`.
"""
