"""Builds the HTML pages of commands: one file each, with its style and its figures inside.

Imports `config`. `builder.py` fills a template, and `figures.py` has common code for figures.
`templates/` has the frame of every page, its parts (tables, facts, figures) and its style. The text
of a page is in the `templates/` of the package that writes it. Start with `builder.render`.
"""
