#!/usr/bin/env bash
# Measure the players in turns, on one core: queue.sh FILE ROUNDS PROBLEM WIDTH EPOCHS BATCHES PLAYER=PYTHON...
# Appends a line to FILE for each run. Round n has seed n.
set -eu
file=$1 rounds=$2 problem=$3 width=$4 epochs=$5 batches=$6
shift 6
here=$(cd "$(dirname "$0")" && pwd)
export PYTHONPATH=$here/../.. OMP_NUM_THREADS=1 CUDA_VISIBLE_DEVICES=
export XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
for seed in $rounds; do
    for each in "$@"; do
        taskset -c 0 "${each#*=}" "$here/players.py" "${each%%=*}" "$problem" "$width" "$epochs" "$batches" "$seed" "$file"
    done
done
