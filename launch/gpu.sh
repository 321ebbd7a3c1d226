#!/usr/bin/env bash
# Trains the default curriculum on wheels on one NVIDIA GPU: bash launch/gpu.sh [key=value ...]
# Needs the extra `gpu`: uv sync --extra gpu. Keys given here win over those below.
#
# The robots are MJX models on wheels, stepped by MJX-Warp with swarmjax's contact solver in the
# place of its own: 85 s from the command on one H200, with nothing compiled before, 22 s of it training.
#   sim.solver=mjx     MJX's own step, unpatched: a third of the environment's speed.
#   robot=planar       the fast option: the same model in the plane, stepped as discs, as in
#                      bash launch/gpu.sh robot=planar stage=s6 arenas=65536 budget=500e6
set -euo pipefail

# JAX's own default, written out because it matters here: JAX takes this share of the card at once,
# and Warp's kernels and temporary arrays live in what is left.
export XLA_PYTHON_CLIENT_MEM_FRACTION="${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.75}"
# JAX's own default again: the networks' products may use TF32 on the tensor cores. The physics never
# goes through them: Warp's kernels are float32. With sim.impl=jax set this to `highest`.
export JAX_DEFAULT_MATMUL_PRECISION="${JAX_DEFAULT_MATMUL_PRECISION:-default}"

exec uv run --extra gpu python -m swarmjax.train \
  sim.impl=warp robot=wheeled arenas=512 budget=8e6 "$@"
