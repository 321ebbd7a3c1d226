"""Builds the HTML pages of commands: one file each, with its style and its figures inside.

This package imports `config`. `builder.py` fills a template, and `figures.py` has common code for
figures. The folder `templates/` has the frame, the parts (tables, facts, figures) and the style
that all pages share. The text of a page is in the folder `templates/` of the package that writes
the page. Read `builder.render` first.
"""
