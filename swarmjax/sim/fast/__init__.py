"""Faster ways to the same physics, which nothing needs: only `sim/dispatch.py` calls them.

`discs.py` steps planar robots, with contacts by `planar_jax.py` or `planar_warp.py`; `warp_step.py`
lets MJX-Warp solve those of wheeled ones by `wheeled_warp.py` (`wheeled_problem.py`,
`wheeled_pairs.py`); `unroll.py` cuts short axes up for XLA. The tests hold each that steps to
MuJoCo C.
"""
