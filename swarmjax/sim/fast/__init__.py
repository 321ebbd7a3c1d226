"""Faster ways to the same physics, which nothing needs: only `sim/dispatch.py` calls them.

`discs.py` steps planar robots, `warp_step.py` and `wheeled_warp.py` solve the contacts of wheeled
ones, `unroll.py` cuts short axes up for XLA. The tests hold each to MuJoCo C.
"""
