#!/usr/bin/env bash
# RLlib 2.60.0: SAC without exploration acts with the mean before the tanh, cut at the bounds.
#
# Guess: `explore=False` takes the mode of the policy as the actor's loss knows it, the squashed mean.
# Behaviour: `TorchSquashedGaussian` squashes samples, but `to_deterministic` returns the mean as it is. The connector then
# clips it to the action space. ray-project/ray#51544 reports the method.
# Seen: a policy with a mean of 0.5, 2 or -1 and hardly any noise draws 0.46, 0.96 and -0.76, which are the tanh of these
# means. With `explore=False` it plays 0.5, 1 and -1.
# The script fails if this changes.
# Why it matters: RLlib's guide evaluates with `explore=False`. An agent that has learned to play 0.77 is evaluated with 1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check \
    "ray[rllib]==2.60.0" torch==2.13.0 gymnasium==1.2.2
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys

import gymnasium
import numpy as np
import torch
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner


class Recorder(gymnasium.Env):
    """Record the actions of episodes of one step."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    actions = []

    def __init__(self, config=None):
        pass

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.actions.append(float(action[0]))
        return np.zeros(1, np.float32), 0.0, True, False, {}


runner = SingleAgentEnvRunner(config=SACConfig().environment(Recorder).debugging(seed=0))
last = [layer for layer in runner.module.pi.modules() if isinstance(layer, torch.nn.Linear)][-1]
seen = {}
for mean in (0.5, 2.0, -1.0):
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.tensor([mean, -5.0]))  # the mean, and the logarithm of the standard deviation
    for explore in (True, False):
        Recorder.actions.clear()
        runner.sample(num_episodes=20, explore=explore, random_actions=False)
        seen[mean, explore] = float(np.median(Recorder.actions))
        print(f"mean {mean}, explore={explore}: {seen[mean, explore]:.3f}")
expected = {(mean, True): np.tanh(mean) for mean in (0.5, 2.0, -1.0)}
expected |= {(0.5, False): 0.5, (2.0, False): 1.0, (-1.0, False): -1.0}
sys.exit(any(abs(seen[case] - value) > 0.01 for case, value in expected.items()))
PYTHON
