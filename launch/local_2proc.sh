#!/usr/bin/env bash
# Trains one run in two processes on this machine, with one CPU device each, connected by gloo:
#   bash launch/local_2proc.sh DIR [key=value ...]
# It shows that several processes work without GPUs. On one machine, one process is faster.
set -euo pipefail
run=${1:?give a run directory, as in: bash launch/local_2proc.sh runs/two}
shift
export JAX_PLATFORMS=cpu JAX_COORDINATOR_ADDRESS="127.0.0.1:${PORT:-12355}" JAX_NUM_PROCESSES=2

start() {
  JAX_PROCESS_ID="$1" uv run python -m swarmjax.train devices=2 run.dir="$run" resume=auto \
    run.distributed=true "${@:2}"
}

start 1 "$@" &
other=$!
code=0
start 0 "$@" || code=$?
wait "$other" || code=$?
exit "$code"
