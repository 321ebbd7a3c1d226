"""Faster ways to compute the same update. They are optional: only `ppo/dispatch.py` calls them.

`fused.py` learns with kernels on an NVIDIA GPU. `blocks.py` splits a whole batch
on a CPU into blocks that fit a core's cache. `sequences.py` trains policies with memory, and leaves
out the sequences without a valid sample.
"""
