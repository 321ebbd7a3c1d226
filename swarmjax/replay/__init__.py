"""Shows episodes as one HTML page, or as a video.

Imports `evaluate`, whose engine steps the episodes, settings and geometry from `task` and `sim`,
`pages`, and `export.folder` to replace files. `record.py` records episodes, `pack.py` compresses
the recordings, and `page.py` and `video.py` show them. Start with `episodes.replay`.
"""
