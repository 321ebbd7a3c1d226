"""Faster ways to the same update, which nothing needs: only `ppo/dispatch.py` calls them.

`tiles.py` learns by the kernels of `fused.py` on an NVIDIA GPU, `blocks.py` takes a whole batch on
a CPU in blocks that stay in a core's cache. `sequences.py` takes policies with memory, by the
sequences of robots that something is learned from.
"""
