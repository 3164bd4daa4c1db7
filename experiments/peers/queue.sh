#!/bin/bash
# Measure the steps in a CPU second, then train all learners: all of them with one seed, then with the next.
#
#   experiments/peers/queue.sh FOLDER XUANCE_PYTHON DI_ENGINE_PYTHON HPAMDP_PYTHON SEED...
#
# A curve that is in the folder already is not made again. If they are set, $CPU_SECONDS ends each training (600 otherwise),
# $SETTINGS are settings of hpamdp's learners, and commands run through the program $THROUGH.
set -u
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1/speed"
folder=$(realpath "$1") xuance=$2 ding=$3 hpamdp=$4
limit=${CPU_SECONDS:-600}
shift 4
export PYTHONPATH=$here/../.. OMP_NUM_THREADS=1

run() {  # run NAME PYTHON SCRIPT BEFORE -- AFTER: the file of the curve stands between BEFORE and AFTER
    [ -e "$folder/$1.csv" ] && return
    file=$folder/$1.csv log=$folder/$1.log python=$2 script=$here/$3
    shift 3
    before=()
    while [ "$1" != -- ]; do before+=("$1"); shift; done
    shift
    cache=$(mktemp -d)  # so that each run compiles for itself
    TORCHINDUCTOR_CACHE_DIR=$cache TORCHINDUCTOR_COMPILE_THREADS=1 \
        ${THROUGH:-} "$python" "$script" "${before[@]}" "$file" "$@" > "$log" 2>&1 || echo "$file: failed, see $log"
    rm -r "$cache"
}

# Steps in a CPU second with the same updates: one for each step on Platform, 100 for each 3,200 steps on Moving.
plain=compile_updates=false
like_di_engine=(num_envs=8 steps_per_batch=400 low.epochs=10 low.minibatch_size=320
    low.hidden_dims=[256,128,64,64] low.critic_hidden_dims=[256,128,64,64])
for seed in "$@"; do
    run speed/xuance_mpdqn_$seed "$xuance" xuance_platform.py mpdqn $seed -- 40
    run speed/pdqn_published_$seed "$hpamdp" hpamdp_learner.py platform pdqn_published $seed -- 40 $plain
    run speed/pdqn_$seed "$hpamdp" hpamdp_learner.py platform pdqn $seed -- 40 $plain low.updates_per_step=1.0
    run speed/di_engine_hppo_$seed "$ding" di_engine_moving.py $seed -- 40
    run speed/hppo_$seed "$hpamdp" hpamdp_learner.py moving hppo $seed -- 40 $plain "${like_di_engine[@]}"
done
for seed in "$@"; do
    run xuance_mpdqn_$seed "$xuance" xuance_platform.py mpdqn $seed -- $limit
    run di_engine_hppo_$seed "$ding" di_engine_moving.py $seed -- $limit
    run pdqn_$seed "$hpamdp" hpamdp_learner.py platform pdqn $seed -- $limit ${SETTINGS:-}
    run hppo_$seed "$hpamdp" hpamdp_learner.py moving hppo $seed -- $limit ${SETTINGS:-}
    run pdqn_published_$seed "$hpamdp" hpamdp_learner.py platform pdqn_published $seed -- $limit ${SETTINGS:-}
done
for seed in "$@"; do
    run xuance_pdqn_$seed "$xuance" xuance_platform.py pdqn $seed -- $limit
done
