"""Where Numba must not compile (NUMBA_DISABLE_JIT=1), kernels are plain functions that give the same numbers."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import hpamdp  # noqa: F401  registers the environments

IDS = [name for name in gymnasium.registry if name.startswith("hpamdp/")]


def play(name: str) -> list[float]:
    """Return the rewards of an episode's first steps and the sum of its last observation."""
    env = gymnasium.make(name)
    env.reset(seed=3)
    env.action_space.seed(3)
    rewards: list[float] = []
    for _ in range(4):
        seen, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        rewards.append(float(reward))
        if terminated or truncated:
            break
    return [*rewards, float(np.sum(seen[0] if isinstance(seen, tuple) else seen))]


@pytest.mark.parametrize(
    "names", [pytest.param(["hpamdp/BoatDock-v0"], id="boats"), pytest.param(IDS, id="all", marks=pytest.mark.slow)]
)
def test_plain_functions_give_the_numbers_of_kernels_and_boats_need_no_torch(names):
    command = [sys.executable, "-W", "error::RuntimeWarning", __file__, *names]
    variables = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    ended = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    all_played, has_torch = json.loads(ended.stdout)
    assert len(names) > 1 or not has_torch
    for name, played in zip(names, all_played, strict=True):
        np.testing.assert_allclose(played, play(name), rtol=1e-5, atol=1e-5, err_msg=name)


if __name__ == "__main__":
    print(json.dumps([[play(name) for name in sys.argv[1:]], "torch" in sys.modules]))
