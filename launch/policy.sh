#!/usr/bin/env bash
# Trains policies on the real body on one NVIDIA GPU, in two runs. On a new H100, five seeds side by
# side took 68 s and 62 s with both programs compiled, which takes half a minute each:
#   bash launch/policy.sh DIR [key=value ...]     e.g. bash launch/policy.sh runs/policy seeds=5 seed=300
# Wheels from the first update, with cheap contacts; then, once every robot arrives, a price on
# contacts between robots that follows a limit, with enough exploration left to learn from it.
# docs/results.md says what was measured of this, and of others.
set -euo pipefail
run=${1:?give a directory for the two runs, as in: bash launch/policy.sh runs/policy}
shift

train() {
  uv run --extra gpu python -m swarmjax.train sim.impl=warp robot=wheeled arenas=512 \
    task.reward.contact=-0.02 "$@"
}

train budget=8e6 run.dir="$run/arrive" "$@"
train budget=8e6 run.dir="$run/avoid" stage=final start="$run/arrive" start_std=reset \
  algo.exploration=scheduled algo.initial_std=0.3 algo.std_floor=0.2 algo.std_interval=2000000 \
  algo.contact_limit=0.03 task.reward.robot_contact=-0.05 task.reward.time=-0.004 \
  task.reward.proximity=-0.001 "$@"
