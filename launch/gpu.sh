#!/usr/bin/env bash
# Trains on one NVIDIA GPU: bash launch/gpu.sh [key=value ...]
# Needs the extra `gpu`: uv sync --extra gpu. Keys given here win over those below.
set -euo pipefail

# JAX's own default, written out because it matters here: JAX takes this share of the card at once,
# and Warp's kernels and temporary arrays live in what is left.
export XLA_PYTHON_CLIENT_MEM_FRACTION="${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.75}"
# JAX's own default again: the networks' products may use TF32 on the tensor cores. The physics never
# goes through them: Warp's kernels are float32. With sim.impl=jax set this to `highest`.
export JAX_DEFAULT_MATMUL_PRECISION="${JAX_DEFAULT_MATMUL_PRECISION:-default}"

# arenas: where an H100's speed levels off; `arenas=auto` fills the card. budget: about a minute of
# training there; the share of targets reached levels off within the first ten seconds.
exec uv run --extra gpu python -m swarmjax.train \
  sim.impl=warp stage=s6 arenas=65536 budget=500e6 "$@"
