#!/usr/bin/env bash
# Runs a command for a Slurm job and passes SIGUSR1 on to it. Requeues the job if the command ends
# with code 75 (it has saved, and should be started again) or 134 (JAX aborts a process whose peer is
# gone).
#   bash launch/requeue.sh COMMAND [ARGUMENT ...]
set -euo pipefail

"$@" &
command=$!
# `scancel --signal` reaches all tasks of a job step. A command without steps is signalled directly.
if [ "${STEPS:-0}" -eq 1 ]; then
  trap 'scancel --signal=USR1 "$SLURM_JOB_ID"' USR1
else
  trap 'kill -USR1 "$command"' USR1
fi
code=0
wait "$command" || code=$?
# A trapped signal interrupts `wait` before the command has ended.
while kill -0 "$command" 2>/dev/null; do
  code=0
  wait "$command" || code=$?
done
if [ "$code" -eq 75 ] || [ "$code" -eq 134 ]; then
  scontrol requeue "${SLURM_ARRAY_JOB_ID:-$SLURM_JOB_ID}${SLURM_ARRAY_TASK_ID:+_$SLURM_ARRAY_TASK_ID}"
  exit 0
fi
exit "$code"
