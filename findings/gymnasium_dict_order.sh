#!/usr/bin/env bash
# Gymnasium 1.4.0: two Dict spaces compare equal and flatten in another order.
#
# Guess: spaces that compare equal flatten equal points to equal vectors.
# Behaviour: Dict sorts the keys of a plain dict, but keeps the order of a list of pairs. Comparison ignores the order.
# flatten, flatten_space and every policy behind them use it.
# Seen: equal, [0 1 0 1 0] and [1 0 0 1 0] for the same point {'a': 1, 'b': 0}. The script fails if this changes.
# Why it matters: the usual check of a loaded agent, `env.observation_space == saved_space`, lets a permuted observation
# pass. The network then reads every column as another one.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check gymnasium==1.4.0
"$folder/venv/bin/python" - <<'PYTHON'
import sys

from gymnasium.spaces import Dict, Discrete, flatten

from_dict = Dict({"b": Discrete(2), "a": Discrete(3)})
from_pairs = Dict([("b", Discrete(2)), ("a", Discrete(3))])
point = {"a": 1, "b": 0}
vectors = [flatten(space, point).tolist() for space in (from_dict, from_pairs)]
print("equal" if from_dict == from_pairs else "different", *vectors)
sys.exit(not (from_dict == from_pairs and vectors == [[0, 1, 0, 1, 0], [1, 0, 0, 1, 0]]))
PYTHON
