#!/usr/bin/env bash
# Trains policies on wheels into a directory of their own, by the command of launch/gpu.sh:
#   bash launch/policy.sh DIR [key=value ...]     e.g. bash launch/policy.sh runs/policy seeds=5 seed=300
# docs/results.md says what was measured of this, and of others.
set -euo pipefail
run=${1:?give a directory for the run, as in: bash launch/policy.sh runs/policy}
shift

exec bash "$(dirname "$0")/gpu.sh" run.dir="$run" "$@"
