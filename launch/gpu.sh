#!/usr/bin/env bash
# Trains the default curriculum with wheeled robots on one NVIDIA GPU:
#   bash launch/gpu.sh [key=value ...]
# Needs the extra `gpu`: uv sync --extra gpu. Keys given here override those below.
#
# The robots are wheeled MJX models. MJX-Warp steps them with swarmjax's contact solver in place of
# its own. On one H200, with nothing compiled before, the command took 85 s, of which training took
# 22 s.
#   sim.solver=mjx     MJX's own step, unpatched: the environment runs at a third of the speed.
#   robot=planar       the fast option: the planar model, stepped as discs. Example:
#                      bash launch/gpu.sh robot=planar stage=s6 arenas=65536 budget=500e6
set -euo pipefail

# This is JAX's default, written out because it matters here. JAX allocates this share of the GPU's
# memory at once. Warp's kernels and temporary arrays use the rest.
export XLA_PYTHON_CLIENT_MEM_FRACTION="${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.75}"
# Also JAX's default: the networks' matrix products may use TF32 on the tensor cores. The physics
# never uses tensor cores, because Warp's kernels are float32. With sim.impl=jax, set this to
# `highest`.
export JAX_DEFAULT_MATMUL_PRECISION="${JAX_DEFAULT_MATMUL_PRECISION:-default}"

exec uv run --extra gpu python -m swarmjax.train \
  sim.impl=warp robot=wheeled arenas=512 budget=8e6 "$@"
