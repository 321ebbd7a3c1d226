"""Reports the results of a run as figures and one page, from the files the run wrote. No JAX.

Imports names and settings from `run`, stages from `task`, the statistics of `evaluate`, and
`pages`. Start with `rows.read`. `table.py` compares several runs.
"""
