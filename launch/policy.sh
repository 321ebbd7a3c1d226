#!/usr/bin/env bash
# Trains policies on the real body on one NVIDIA GPU, by one command:
#   bash launch/policy.sh DIR [key=value ...]     e.g. bash launch/policy.sh runs/policy seeds=5 seed=300
# Five seeds side by side took 54 s on an H100 with their program compiled before, 34 s of it training;
# compiling takes half a minute more, once. Keys given here win over those below.
# docs/results.md says what was measured of this, and of others.
set -euo pipefail
run=${1:?give a directory for the run, as in: bash launch/policy.sh runs/policy}
shift

exec uv run --extra gpu python -m swarmjax.train \
  sim.impl=warp robot=wheeled arenas=512 budget=8e6 run.dir="$run" "$@"
