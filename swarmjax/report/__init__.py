"""Reports the results of a run as figures and one page, from the files that the run has written.

This package imports names and settings from `run`, stages from `task`, the statistics of
`evaluate`, and `pages`, but not JAX. Read `rows.read` first. `table.py` compares several runs.
"""
