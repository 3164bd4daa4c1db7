#!/bin/bash
# Train all players on all problems, one after another: all of them with one seed, then with the next.
#
#   experiments/own_problems/queue.sh FOLDER HPAMDP_PYTHON SB3_PYTHON CPU_SECONDS SEED...
#
# A curve that is in the folder already is not made again. If they are set, $PROBLEMS, $LEARNERS and $FORMS name some of them.
set -u
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
folder=$(realpath "$1") hpamdp=$2 sb3=$3 limit=$4
shift 4
export PYTHONPATH=$here/../.. OMP_NUM_THREADS=1

run() {  # run NAME PYTHON SCRIPT PROBLEM PLAYER SEED
    file=$folder/$1.csv
    [ -e "$file" ] && return
    (cd "$folder" && "$2" "$here/$3" "$4" "$5" "$6" "$file" "$limit" > "$folder/$1.log" 2>&1) || echo "$file: failed"
}

for seed in "$@"; do
    for problem in ${PROBLEMS:-queue pricing machine greenhouse picking irrigation vehicle battery inventory heating}; do
        for learner in ${LEARNERS:-hppo pdqn hsac}; do
            run "${problem}_${learner}_$seed" "$hpamdp" hpamdp_learner.py "$problem" "$learner" "$seed"
        done
        for form in ${FORMS:-raw normalised informed}; do
            run "${problem}_sb3_${form}_$seed" "$sb3" sb3_ppo.py "$problem" "$form" "$seed"
        done
    done
done
