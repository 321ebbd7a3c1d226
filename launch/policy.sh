#!/usr/bin/env bash
# Trains the policy of docs/results.md on one NVIDIA GPU. On a new H100, five seeds side by side took
# 213 s (114 s of them Warp's kernels and compiling), the second run 91 s with its program compiled:
#   bash launch/policy.sh DIR [key=value ...]     e.g. bash launch/policy.sh runs/policy seeds=5 seed=300
# The real body from the first update, with cheap contacts; then, once every robot arrives, dear
# ones, with enough exploration left to learn from them. docs/results.md says what each part brings.
set -euo pipefail
run=${1:?give a directory for the two runs, as in: bash launch/policy.sh runs/policy}
shift

train() {
  uv run --extra gpu python -m swarmjax.train sim.impl=warp robot=wheeled arenas=512 "$@"
}

train budget=8e6 run.dir="$run/arrive" "$@"
train budget=8e6 run.dir="$run/avoid" stage=final start="$run/arrive" start_std=reset \
  algo.exploration=scheduled algo.initial_std=0.3 algo.std_floor=0.2 algo.std_interval=2000000 \
  task.reward.contact=-0.1 task.reward.time=-0.004 task.reward.proximity=-0.001 "$@"
