#!/usr/bin/env bash
# Check and time environments, the planner and H-PPO on a device: experiments/speed/cuda.sh [DEVICE [LARGEST [STEPS]]]
# Without arguments: cuda, up to 10^7 boats and 2,000,000 presses, in under eight minutes.
# A test of the script itself: experiments/speed/cuda.sh cpu 1000 20000
set -euo pipefail
device=${1:-cuda} largest=${2:-10000000} steps=${3:-2000000}
cd "$(dirname "$0")/../.."
export PYTHONPATH=.
if [ "$device" != cpu ] && ! python -c "import sys, torch; sys.exit(not torch.cuda.is_available())"; then
    echo "needs a CUDA device, its driver and PyTorch's build for CUDA; here: $(python -c 'import torch; print(torch.__version__)')"
    exit 1
fi
folder=$(mktemp -d)
trap 'rm -rf "$folder" "$folder.errors"' EXIT
timeout 180 python experiments/speed/on_device.py "$device" "$largest"
for settings in "num_envs=1024 steps_per_batch=8" "num_envs=16384 steps_per_batch=8 low.minibatch_size=32768"; do
    for compiled in false true; do
        echo "H-PPO, $settings, compile_updates=$compiled"
        timeout 70 python run.py high=none low=hppo env.controller=congruent device="$device" total_frames="$steps" \
            compile_updates=$compiled eval.every=0 film=false hydra.run.dir="$folder" overwrite=true seed=0 $settings \
            2> "$folder.errors" | tail -12 || { cat "$folder.errors"; echo "failed, or not over after 70 s"; }
    done
done
