"""The HTML pages that commands write: one file each, with its style and its figures inside.

Imports `config`. `builder.py` fills a template, `figures.py` holds what figures have in common.
`templates/` has the frame of every page, its parts (tables, facts, figures) and its style; what a
page says stands in the `templates/` of the room that writes it. Start with `builder.render`.
"""
