"""Serves a page on the loopback that follows a run: its curves, and a replay of its newest policy.

Imports `pages`, the figures of `report`, the episodes of `replay`, and the run directory's readers
of `run`. `standing.py` finds out whether a run trains, and `newest.py` replays its newest policy.
`view.py` keeps the shown data up to date, and `server.py` answers requests. Start with
`view.Views`.
"""
