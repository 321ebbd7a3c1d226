"""Serves a page on this machine that shows how a run is going.

This package imports `pages`, the page of `report`, and the functions of `run` that read a run
directory. `status.py` finds out whether a run trains, `live_page.py` draws the page, and
`server.py` answers requests. Read `live_page.LivePage` first.
"""
