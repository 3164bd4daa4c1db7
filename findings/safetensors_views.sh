#!/usr/bin/env bash
# safetensors 0.8.0: its NumPy functions write transposed and strided arrays wrong, without a line.
#
# Guess: a view is copied in C order, or refused, as safetensors.torch refuses it.
# Behaviour: safetensors.numpy writes the memory below a view together with the view's shape. A transposed matrix comes
# back with its values in the wrong places, and every second value comes back as the first half of all.
# np.ascontiguousarray before saving avoids it.
# Seen: [[0 3] [1 4] [2 5]] comes back as [[0 1] [2 3] [4 5]], and [0 2] as [0 1]. The script fails if this
# changes.
# Why it matters: `weight.T` is how a linear layer's weights go from JAX or NumPy to torch and back. All shapes fit.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check safetensors==0.8.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import numpy as np
from safetensors.numpy import load, save

arrays = {"transposed": np.arange(6).reshape(2, 3).T, "every_second": np.arange(4)[::2]}
exact = {}
for name, array in arrays.items():
    loaded = load(save({name: array}))[name]
    exact[name] = np.array_equal(array, loaded)
    print(name, array.tolist(), "comes back as", loaded.tolist())
copied = load(save({"copied": np.ascontiguousarray(arrays["transposed"])}))["copied"]
exact["copied"] = np.array_equal(copied, arrays["transposed"])
print("exact:", exact)
sys.exit(exact["transposed"] or exact["every_second"] or not exact["copied"])
PYTHON
