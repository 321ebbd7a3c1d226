"""Which stage each arena trains on, and when that changes.

Imports `task` for stages and for episodes that have ended. `engine.py` counts, judges and hands
over to a mode; `modes.py` has one pure function a mode; `log.py` puts decisions into words. Start
with `engine.advance`.
"""
