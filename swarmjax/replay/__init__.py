"""Shows episodes as one HTML page, or as a video.

This package imports settings and geometry from `task` and `sim`, `evaluate`, whose engine steps the
episodes, and `pages` and `outputs.py`, which write files. `record.py` records episodes, `pack.py`
compresses the recordings, and `page.py` and `video.py` show them. Read `episodes.replay` first.
"""
