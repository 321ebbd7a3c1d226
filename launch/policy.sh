#!/usr/bin/env bash
# Trains policies for wheeled robots into a directory of your choice, with launch/gpu.sh:
#   bash launch/policy.sh DIR [key=value ...]
#   e.g. bash launch/policy.sh runs/policy seeds=5 seed=300
# docs/results.md has measured results of these and other policies.
set -euo pipefail
run=${1:?give a directory for the run, as in: bash launch/policy.sh runs/policy}
shift

exec bash "$(dirname "$0")/gpu.sh" run.dir="$run" "$@"
