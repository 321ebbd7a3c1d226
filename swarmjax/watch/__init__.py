"""A page on the loopback that follows a run: its curves, and what its newest policy does.

Imports figures of `report`, episodes of `replay`, `pages`, and what a run's directory tells by
`run`. `standing.py` says whether a run trains, `newest.py` replays its newest policy, `view.py`
keeps what is shown as new as it should be, `server.py` answers. Start with `view.Views`.
"""
