"""Serves a page on this machine that shows a run's curves and a replay of its newest policy.

This package imports `pages`, the figures of `report`, the episodes of `replay`, and the functions
of `run` that read a run directory. `status.py` finds out whether a run trains, and `newest.py`
replays its newest policy. `view.py` keeps the shown data up to date, and `server.py` answers
requests. Start with `view.Views`.
"""
