#!/bin/bash
# Train PEARL with seeds 1 to 3 on Pinball and Office, and hpamdp's learners with seeds 120 to 122 on Pinball and 130 to 139 on Office.
#
#   experiments/pearl/queue.sh FOLDER PEARL_FOLDER PEARL_PYTHON HPAMDP_PYTHON
#
# PEARL_FOLDER is a clone of the authors' repository. A curve that is in FOLDER already is not made again.
set -u
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
folder=$(realpath "$1") clone=$(realpath "$2") pearl=$3 hpamdp=$4
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

run() {  # run NAME COMMAND...: the command's last argument is the file of the curve
    file=$folder/$1.csv
    [ -e "$file" ] && return
    shift
    "$@" "$file" > "${file%.csv}.log" 2>&1 || echo "$file: failed, see ${file%.csv}.log"
}

declare -A seeds=([pinball]="120 121 122" [office]="130 131 132 133 134 135 136 137 138 139")
for problem in pinball office; do
    for seed in ${seeds[$problem]}; do
        PYTHONPATH=$here/../.. run hpamdp_${problem}_$seed "$hpamdp" "$here/learner.py" $problem $seed
    done
    for seed in 1 2 3; do
        run pearl_${problem}_$seed "$pearl" "$here/pearl.py" "$clone" $problem $seed
    done
done
