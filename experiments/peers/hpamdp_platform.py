"""Train a learner of hpamdp on Platform.

python experiments/peers/hpamdp_platform.py LEARNER SEED STEPS    prints a row of results.csv
"""

from __future__ import annotations

import sys
import time

from scoring import score

import hpamdp


def main(learner: str, seed: int, steps: int) -> None:
    hpamdp.make("platform").rollout(2)  # compiles the kernels, once for each machine
    began = time.process_time()
    agent = hpamdp.train(
        "platform", low=learner, seed=seed, total_frames=steps, threads=1, progress=False, **{"eval.every": 0}
    )
    cpu_s = time.process_time() - began
    scores = score(agent.act)
    frames = int(agent.history[-1]["frames"])
    row = ["hpamdp", hpamdp.__version__, learner, frames, seed, *scores.values(), round(cpu_s, 1)]
    print(*row, sep=",")


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:4]))
