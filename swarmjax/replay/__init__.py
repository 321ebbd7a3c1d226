"""Episodes as one HTML page, or as a film.

Imports `evaluate`, whose engine steps them, settings and geometry of `task` and `sim`, `pages`, and
`export.folder` to replace files. `record.py` keeps what happened, `pack.py` makes it
small, `page.py` and `video.py` show it. Start with `episodes.replay`.
"""
