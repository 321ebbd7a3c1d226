"""Optional, faster ways to compute the update of `ppo.py`; only `ppo/dispatch.py` calls them.

`fused.py` learns with kernels on an NVIDIA GPU. On a CPU, `blocks.py` splits a batch that is one
minibatch into blocks that fit a core's cache. `sequences.py` trains policies with memory, and
leaves out the sequences without a valid sample.
"""
