"""The published experiment several times over: trained, judged, and held against its claims.

Imports the rooms that it runs. `arms.py` trains, `judge.py` judges, `claims.py` says what the paper
claims and when that holds, `page.py` writes the report. Start with `__main__.main`.
"""
