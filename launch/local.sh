#!/usr/bin/env bash
# Trains one run on all NVIDIA GPUs of this machine, with one process per GPU:
#   uv sync --extra gpu        once
#   bash launch/local.sh DIR [key=value ...]
#   e.g. bash launch/local.sh runs/all arenas=131072 budget=2e9
# GPUS=2 uses only the first two. The same command continues a run that was stopped.
set -euo pipefail
run=${1:?give a run directory, as in: bash launch/local.sh runs/all}
shift
gpus=${GPUS:-$(nvidia-smi -L 2>/dev/null | wc -l)}
if [ "$gpus" -lt 1 ]; then
  echo "launch/local.sh: error: nvidia-smi finds no GPU: see launch/local_2proc.sh for CPUs." >&2
  exit 2
fi

start() {
  export CUDA_VISIBLE_DEVICES="$1" JAX_PROCESS_ID="$1" JAX_NUM_PROCESSES="$gpus"
  export JAX_COORDINATOR_ADDRESS="127.0.0.1:${PORT:-12355}"
  exec "${PYTHON:-.venv/bin/python}" -m swarmjax.train devices="$gpus" run.dir="$run" resume=auto \
    run.distributed=true "${@:2}"
}

processes=()
# Background processes of bash ignore Ctrl-C, so this trap passes it on.
trap 'kill -TERM "${processes[@]}" 2>/dev/null || true' INT TERM
for ((i = 0; i < gpus; i++)); do
  start "$i" "$@" &
  processes+=("$!")
done
code=0
for process in "${processes[@]}"; do
  # A signal interrupts `wait` before the process has ended.
  while kill -0 "$process" 2>/dev/null; do
    wait "$process" || code=$?
  done
  wait "$process" || code=$?
done
exit "$code"
