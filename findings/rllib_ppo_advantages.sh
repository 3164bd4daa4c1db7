#!/usr/bin/env bash
# RLlib 2.60.0: PPO standardises advantages together with one row a piece of episode that is no step.
#
# Guess: the mean and standard deviation of the advantages are those of the steps in the loss. `loss_mask` leaves out the
# row that RLlib adds behind each episode for the value of its last state.
# Behaviour: `GeneralAdvantageEstimation` standardises before the mask counts. An added row's advantage is built from the
# first value of the next episode in the batch and the value of the last state, which a terminated episode never trains.
# Seen: 100 episodes of one step have returns of 11 and 9 by turns, a critic that expects 10, and 0 in the state after the
# end. All steps get negative advantages, -0.77 and -1.17. Over the steps alone they are 1 and -1.
# The script fails if this changes.
# Why it matters: in short episodes a better action than expected can be made less likely, and the scale of the
# advantages depends on values in states where nothing is chosen.
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
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

OBSERVATION, ACTION = gymnasium.spaces.Box(0.0, 1.0, (1,)), gymnasium.spaces.Discrete(2)
seen = {}


class Critic(DefaultPPOTorchRLModule):
    """Expect 10 in the first state, whose observation is 0, and nothing after the end, where it is 1."""

    def compute_values(self, batch, embeddings=None):
        return 10.0 * (1.0 - batch["obs"][:, 0])


class Recorder(PPOTorchLearner):
    """Record what the loss is given."""

    def compute_loss_for_module(self, *, module_id, config, batch, fwd_out):
        seen["advantages"], seen["is_step"] = batch["advantages"].numpy(), batch["loss_mask"].numpy()
        return super().compute_loss_for_module(module_id=module_id, config=config, batch=batch, fwd_out=fwd_out)


def episode(reward):
    """Return an episode of one step that terminates."""
    found = SingleAgentEpisode(
        observations=[np.zeros(1, np.float32)], observation_space=OBSERVATION, action_space=ACTION
    )
    outputs = {"action_logp": np.float32(np.log(0.5)), "action_dist_inputs": np.zeros(2, np.float32)}
    found.add_env_step(np.ones(1, np.float32), 0, reward, terminated=True, extra_model_outputs=outputs)
    found.to_numpy()
    return found


config = PPOConfig().environment(observation_space=OBSERVATION, action_space=ACTION)
config.learners(num_learners=0, learner_class=Recorder).training(num_epochs=1)
config.rl_module(rl_module_spec=RLModuleSpec(module_class=Critic))
learner = config.build_learner(spaces={"default_policy": (OBSERVATION, ACTION)})
learner.update(episodes=[episode(reward) for reward in (11.0, 9.0) * 50])
steps = seen["advantages"][seen["is_step"]]
print("rows", len(seen["advantages"]), "steps", len(steps))
print("advantages of returns 11 and 9, where 10 was expected:", np.round(steps[:2], 2))
print("over the steps alone:", np.round((steps[:2] - steps.mean()) / steps.std(), 2))
sys.exit(len(steps) != 100 or not np.allclose(steps[:2], (-0.77, -1.17), atol=0.02))
PYTHON
