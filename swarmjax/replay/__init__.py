"""Shows episodes as one HTML page, or as a video.

Imports settings and geometry from `task` and `sim`, `pages`, `outputs.py` to write files, and
`evaluate`, whose engine steps the episodes. `record.py` records episodes, `pack.py` compresses the
recordings, and `page.py` and `video.py` show them. Start with `episodes.replay`.
"""
