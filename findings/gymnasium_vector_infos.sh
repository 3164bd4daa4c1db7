#!/usr/bin/env bash
# Gymnasium 1.4.0: the infos of a vector environment take the type that the first copy reports.
#
# Guess: NumPy's promotion, so 0 and 0.75 become [0., 0.75].
# Behaviour: the array of a key gets the dtype of the first copy that has the key. Later values are cast without a line:
# fractions beside a first 0 are cut, and numbers beside a first False become True. The copies' order decides.
# Seen: copies with costs 0 and 0.75 give [0 0]; in the other order [0.75 0.]; counts False and 2 give [False True].
# Why it matters: costs, success rates and action masks often stand in infos. `"cost": 0` in the steps without a cost is
# enough to lose the costs of all other copies in that step, in each mode of autoreset.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check gymnasium==1.4.0
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import SyncVectorEnv


class Costs(gymnasium.Env):
    observation_space = Box(-1, 1, (1,))
    action_space = Discrete(2)

    def __init__(self, value):
        self.value = value

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {"cost": self.value}


seen = []
for values in [(0, 0.75), (0.75, 0), (False, 2)]:
    envs = SyncVectorEnv([lambda value=value: Costs(value) for value in values])
    envs.reset(seed=0)
    info = envs.step(np.array([0, 0]))[4]
    print(values, "become", info["cost"])
    seen.append(info["cost"].tolist())
sys.exit(seen != [[0, 0], [0.75, 0.0], [False, True]])
PYTHON
