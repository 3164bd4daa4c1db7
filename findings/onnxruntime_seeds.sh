#!/usr/bin/env bash
# ONNX Runtime 1.32.0: different seeds of random nodes are the same seed.
#
# Guess: nodes with different values of the attribute `seed` draw different numbers.
# Behaviour: the attribute is a 32-bit float and is cut to a whole number. So 0.1 and 0.9 are the same, and so are many
# neighbouring whole numbers above 2 ** 24. Such nodes draw equal numbers in every run. A session goes on with its
# stream from run to run, and `onnxruntime.set_seed` changes only sessions that are built after it.
# Seen: equal draws for 0.1 and 0.9, and for 123456789 and 123456790; different ones for 1 and 2. The script fails if
# this changes.
# Why it matters: a policy with two heads that draw, with seeds made from the time or a hash, draws correlated actions.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check onnxruntime==1.32.0 onnx==1.23.2 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import numpy as np
import onnxruntime
from onnx import TensorProto, helper


def session_of(seeds):
    names = [f"draw_{number}" for number in range(len(seeds))]
    nodes = [
        helper.make_node("RandomNormal", [], [name], shape=[4], **({} if seed is None else {"seed": float(seed)}))
        for name, seed in zip(names, seeds)
    ]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in names]
    graph = helper.make_graph(nodes, "draws", [], outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    return onnxruntime.InferenceSession(model.SerializeToString())


seen = []
for seeds in [(0.1, 0.9), (123456789, 123456790), (1, 2)]:
    session = session_of(seeds)
    runs = [session.run(None, {}) for _ in range(3)]
    seen.append(all(np.array_equal(*run) for run in runs))
    print(seeds, "equal draws" if seen[-1] else "different draws")
onnxruntime.set_seed(3)
session = session_of([None])
first = session.run(None, {})[0]
onnxruntime.set_seed(3)
repeated = np.array_equal(first, session.run(None, {})[0]), np.array_equal(first, session_of([None]).run(None, {})[0])
print("after set_seed again: the same session repeats", repeated[0], "- a new one repeats", repeated[1])
sys.exit(seen != [True, True, False] or repeated != (False, True))
PYTHON
