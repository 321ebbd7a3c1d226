"""Faster, optional code for the same physics; only `sim/dispatch.py` calls it.

`discs.py` steps planar robots. Their contacts are solved by `planar_jax.py` or `planar_warp.py`,
and contacts with friction by `rubbing_jax.py` or `rubbing_warp.py`. In Warp, `gaps_warp.py` lists
the contacts, for many robots through the cells of `cells_warp.py`, and `contacts_warp.py` deals
them out to the threads. `senses_warp.py` looks around from each robot. For wheeled robots,
`wheeled_warp.py` (with `wheeled_problem.py` and `wheeled_pairs.py`) replaces the contact solver of
MJX-Warp. `paths_warp.py` finds shortest paths. `arenas_warp.py` makes kernels work under `vmap`.
Tests compare each physics step with MuJoCo C.
"""
