#!/usr/bin/env bash
# SMPyBandits 0.9.7: its discounted bandits do not discount as their names say.
#
# `DiscountedThompson`: a reward fades the counts of the arm that was played, once more for each other arm, and those of
# no other arm. So an
# arm that is not played keeps its old counts for ever, and a change of its reward is noticed late.
# `DiscountedUCB`: its discounted pulls are whole numbers, since the array has an integer dtype. With gamma 0.9, the
# number of pulls of an arm never leaves 1.
#
# Seen on 2026-11-29, Python 3.11:
#   DiscountedThompson, counts of arm 1 before and after 20 rewards of arm 0: [0.0, 0.5] [0.0, 0.5]
#   DiscountedUCB, discounted pulls of arm 0 after 5 pulls: 1 (the sum of 0.9 ** i is 4.1)
#
# For users: compare a forgetting bandit with the formula, not with these classes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check SMPyBandits==0.9.7 numpy==1.26.4 scipy==1.11.4
"$folder/venv/bin/python" -W ignore - <<'PY'
import warnings; warnings.filterwarnings("ignore")
from SMPyBandits.Policies import DiscountedThompson, DiscountedUCB
thompson = DiscountedThompson(2, gamma=0.5)
thompson.startGame()
thompson.getReward(1, 1.0)
counts = lambda arm: [float(n) for n in thompson.posterior[arm].N]
before = counts(1)
for _ in range(20):
    thompson.getReward(0, 1.0)
after, played = counts(1), counts(0)
print("DiscountedThompson, counts of arm 1 before and after 20 rewards of arm 0:", before, after, "those of arm 0:", played)
ucb = DiscountedUCB(2, gamma=0.9)
ucb.startGame()
for _ in range(5):
    ucb.getReward(0, 1.0)
print("DiscountedUCB, discounted pulls of arm 0 after 5 pulls:", ucb.discounted_pulls[0], ucb.discounted_pulls.dtype)
assert before == after
assert int(ucb.discounted_pulls[0]) == ucb.discounted_pulls[0] and ucb.discounted_pulls.dtype.kind == "i"
PY
