#!/usr/bin/env bash
# river 0.26.1: its Beta bandits count every reward other than 0 as a success.
#
# Guess: rewards from 0 to 1 are counted in fractions, or refused.
# Behaviour: `proba.Beta.update(x)` adds 1 to alpha if `x` is true. So 0.1 and -2 count as 1. `BayesUCB` has no other
# posterior, also not by `reward_obj`, and `ThompsonSampling` is documented with this one.
# Seen: alpha 3 after 0.1 and -2; BayesUCB with rewards around 0.1, 0.5 and 0.9 plays the first arm that it draws in all
# of 2,000 decisions, for each of five seeds. The script fails if this changes.
# Why it matters: returns are seldom 0 or 1. A comparison with these bandits compares with no learning at all.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check river==0.26.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys

import numpy as np
from river import bandit, proba

posterior = proba.Beta(1, 1)
for reward in (0.1, -2.0):
    posterior.update(reward)
print("after rewards 0.1 and -2: alpha", posterior.alpha, "beta", posterior.beta)
num_arms = []
for seed in range(5):
    random = np.random.default_rng(seed)
    policy = bandit.BayesUCB(seed=seed)
    chosen = [0, 0, 0]
    for _ in range(2000):
        arm = policy.pull([0, 1, 2])
        chosen[arm] += 1
        policy.update(arm, float((0.1, 0.5, 0.9)[arm] + 0.05 * random.random()))
    print("seed", seed, "BayesUCB chose:", chosen)
    num_arms.append(sum(count > 0 for count in chosen))
sys.exit((posterior.alpha, posterior.beta) != (3, 1) or num_arms != [1] * 5)
PYTHON
