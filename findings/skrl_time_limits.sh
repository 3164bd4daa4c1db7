#!/usr/bin/env bash
# skrl 2.1.1: by default, PPO's advantages go on through a time limit into the next episode.
#
# Guess: a time limit ends the sum, as a termination does; `time_limit_bootstrap=False`, the default, adds no value to it.
# Behaviour: the sum of the generalised advantage estimation ends at terminations only. At a time limit it goes on with
# the next episode, whose first value takes the place of the last state's. With `time_limit_bootstrap=True` it ends.
# Seen: an episode of rewards 0, 0 that ends at a time limit, then one of 100, 100, has returns 200, 200, 200, 100. With
# `time_limit_bootstrap=True`, or if the episodes terminate, they are 0, 0, 200, 100.
# The script fails if this changes.
# Why it matters: rewards of an episode are credited to the actions of the episode before it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check skrl==2.1.1 torch==2.13.0 gymnasium==1.4.0
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys

import torch
from skrl.agents.torch.ppo import PPO_CFG
from skrl.agents.torch.ppo.ppo import compute_gae


def column(*values):
    return torch.tensor(values)[:, None]


def returns(terminated, truncated, bootstrap):
    found, _ = compute_gae(
        rewards=column(0.0, 0.0, 100.0, 100.0),
        terminated=column(*terminated),
        truncated=column(*truncated),
        values=torch.zeros(4, 1),
        last_values=torch.zeros(1, 1),
        discount_factor=1.0,
        lambda_coefficient=1.0,
        time_limit_bootstrap=bootstrap,
    )
    return found.flatten().tolist()


ends, never = (False, True, False, True), (False,) * 4
default = PPO_CFG().time_limit_bootstrap
seen = {
    "time limit, default": returns(never, ends, default),
    "time limit, time_limit_bootstrap=True": returns(never, ends, True),
    "termination, default": returns(ends, never, default),
}
for name, values in seen.items():
    print(name, values)
cut = [0.0, 0.0, 200.0, 100.0]
sys.exit(default or list(seen.values()) != [[200.0, 200.0, 200.0, 100.0], cut, cut])
PYTHON
