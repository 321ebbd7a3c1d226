"""What a run came to, in figures and on one page, from the files that it wrote. No JAX.

Imports names and settings of `run`, stages of `task`, the statistics of `evaluate`, and `pages`.
Start with `rows.read`; `table.py` puts several runs beside each other.
"""
