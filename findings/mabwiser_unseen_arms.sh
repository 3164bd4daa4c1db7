#!/usr/bin/env bash
# MABWiser 2.7.4: UCB1 never plays an arm that the first fit has not seen.
#
# Guess: UCB1 plays every arm once before it compares bounds, as in Auer et al. (2002).
# Behaviour: the arm's bound stays 0 until it has a reward, and no bonus is added to it. The bounds of the other arms are
# above 0, so it is never chosen, however large alpha is. A learner that starts with one reward plays one arm for ever.
# Seen: arms with means 0.2, 0.3 and 0.9, first fit with arms 0 and 1: arm 2 is chosen 0 times of 300, with alpha 1.25
# and with alpha 100. Thompson sampling finds it. The script fails if this changes.
# Why it matters: in a comparison of bandits that starts online, with no log of all arms, UCB1 looks useless.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check mabwiser==2.7.4
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys

import numpy as np
from mabwiser.mab import MAB, LearningPolicy

policies = {
    "UCB1, alpha 1.25": LearningPolicy.UCB1(alpha=1.25),
    "UCB1, alpha 100": LearningPolicy.UCB1(alpha=100.0),
    "Thompson sampling": LearningPolicy.ThompsonSampling(),
}
chosen = {}
for name, policy in policies.items():
    random = np.random.default_rng(0)
    bandit = MAB([0, 1, 2], policy, seed=1)
    bandit.fit([0, 0, 1], [1, 0, 0])
    chosen[name] = [0, 0, 0]
    for _ in range(300):
        arm = bandit.predict()
        chosen[name][arm] += 1
        bandit.partial_fit([arm], [int(random.random() < (0.2, 0.3, 0.9)[arm])])
    print(name, "chosen:", chosen[name])
sys.exit(any(chosen[name][2] > 0 for name in list(policies)[:2]) or chosen["Thompson sampling"][2] < 200)
PYTHON
