"""Repeats the published experiment with several seeds and checks the paper's claims.

This package imports the packages that it runs. `arms.py` trains, `judge.py` evaluates, `claims.py`
holds the paper's claims and their criteria, and `page.py` writes the report. Read `__main__.main`
first.
"""
