#!/usr/bin/env bash
# Gymnasium 1.4.0: resetting one copy of a vector environment clears the running returns of all copies.
#
# Guess: with AutoresetMode.DISABLED, reset(options={"reset_mask": mask}) clears the statistics of the masked copies.
# Behaviour: the vector wrapper RecordEpisodeStatistics clears the returns and lengths of all copies at any reset. Copies
# that go on report the part of their episode since another copy's last reset.
# Seen: episodes of 3 and 8 steps with reward 1: the second is reported as r 2, l 2. Without a partial reset (next-step
# autoreset), r 8, l 8. The script fails if this changes.
# Why it matters: learning curves show too short episodes and too low returns, more so with more copies.
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
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics


class Lasting(gymnasium.Env):
    observation_space = Box(-1, 1, (1,))
    action_space = Discrete(2)

    def __init__(self, num_steps):
        self.num_steps = num_steps

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.step_count += 1
        return np.zeros(1, np.float32), 1.0, self.step_count == self.num_steps, False, {}


seen = {}
for mode in (AutoresetMode.DISABLED, AutoresetMode.NEXT_STEP):
    copies = [lambda num_steps=num_steps: Lasting(num_steps) for num_steps in (3, 8)]
    envs = RecordEpisodeStatistics(SyncVectorEnv(copies, autoreset_mode=mode))
    envs.reset(seed=0)
    for _ in range(8):
        _, _, terminated, _, info = envs.step(np.array([0, 0]))
        if terminated[1]:
            seen[mode] = (float(info["episode"]["r"][1]), int(info["episode"]["l"][1]))
            print(mode.name, "the second copy's return and length:", *seen[mode])
        if mode == AutoresetMode.DISABLED and terminated.any():
            envs.reset(options={"reset_mask": terminated})
sys.exit(seen != {AutoresetMode.DISABLED: (2.0, 2), AutoresetMode.NEXT_STEP: (8.0, 8)})
PYTHON
