#!/usr/bin/env bash
# Minari 0.5.4: tables of bytes become JPEG by their shape, from 32 x 32 on.
#
# Behaviour: a uint8 Box from 0 to 255 with two or three dimensions is stored as lossy JPEG if its first two dimensions
# are at least 32. So (31, 31, 3) and channels first (3, 64, 64) come back exactly. (32, 32, 3) does not, and neither does
# a 32 x 32 table without channels. The extra `hdf5` does not install Pillow, which its storage imports.
# Seen: exact, changed, changed, exact (31x31x3, 32x32x3, 32x32, 3x64x64). The script fails if this changes.
# Why it matters: grid worlds and masks are exact numbers. A policy learned from the data set sees other ones.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check "minari[hdf5]==0.5.4" gymnasium==1.4.0 pillow==11.3.0
export MINARI_DATASETS_PATH="$folder/data"
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import minari
import numpy as np
from gymnasium.spaces import Box, Discrete
from minari.data_collector import EpisodeBuffer

random = np.random.default_rng(0)
exact = {}
for number, shape in enumerate([(31, 31, 3), (32, 32, 3), (32, 32), (3, 64, 64)]):
    seen = random.integers(0, 256, (4, *shape), np.uint8)
    episode = EpisodeBuffer(
        id=0,
        observations=list(seen),
        actions=[0, 1, 0],
        rewards=[0.0, 0.0, 1.0],
        terminations=[False, False, True],
        truncations=[False, False, False],
    )
    dataset = minari.create_dataset_from_buffers(
        f"table/shape-v{number}", [episode], observation_space=Box(0, 255, shape, np.uint8), action_space=Discrete(2)
    )
    exact[shape] = bool(np.array_equal(dataset[0].observations, seen))
    print(shape, "exact" if exact[shape] else "changed")
sys.exit(list(exact.values()) != [True, False, False, True])
PYTHON
