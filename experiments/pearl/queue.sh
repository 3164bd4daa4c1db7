#!/bin/bash
# Train PEARL with seeds 1 to 3, and hpamdp's learners with seeds 120 to 122, on Pinball and Office.
#
#   experiments/pearl/queue.sh FOLDER PEARL_FOLDER PEARL_PYTHON HPAMDP_PYTHON
#
# PEARL_FOLDER is a clone of the authors' repository. A curve that is in FOLDER already is not made again.
set -u
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
folder=$(realpath "$1") clone=$(realpath "$2") pearl=$3 hpamdp=$4
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
for problem in pinball office; do
    for seed in 120 121 122; do
        file=$folder/hpamdp_${problem}_$seed.csv
        [ -e "$file" ] || PYTHONPATH=$here/../.. "$hpamdp" "$here/learner.py" $problem $seed "$file" > "${file%.csv}.log" 2>&1
    done
    for seed in 1 2 3; do
        file=$folder/pearl_${problem}_$seed.csv
        [ -e "$file" ] || "$pearl" "$here/pearl.py" "$clone" $problem $seed "$file" > "${file%.csv}.log" 2>&1
    done
done
