"""Faster, optional code for the same physics; only `sim/dispatch.py` calls it.

`discs.py` steps planar robots. `planar_jax.py` or `planar_warp.py` computes their contact forces,
or with friction `rubbing_jax.py` or `rubbing_warp.py`. In Warp, `gaps_warp.py` lists the contacts
and `contacts_warp.py` distributes them among the threads; with many robots, `gaps_warp.py` uses the
grid of `cells_warp.py`. `senses_warp.py` computes what the sensors of each robot see. For wheeled
robots, `wheeled_warp.py` (with `wheeled_problem.py` and `wheeled_pairs.py`) replaces the contact
solver of MJX-Warp. `paths_warp.py` finds shortest paths. `arenas_warp.py` makes Warp kernels work
under `vmap`. Tests compare each physics step with MuJoCo C.
"""
