"""Every learner in thirty action spaces: its actions lie inside, also after updates, or it refuses in one line.

Each learner meets a tenth of the spaces, and the others with `-m slow`.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from action_trees import TREES, Recorder
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp.env.decisions import with_decisions
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.hyar import HyAR
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.paddpg import PADDPG
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.low_level.qpamdp import QPAMDP
from hpamdp.policies.low_level.random import Random
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

REPLAY = {"warmup_steps": 8, "batch_size": 4, "hidden_dims": (8,), "updates_per_step": 0.25}
PLANS = {"warmup_steps": 8, "updates_per_step": 0.25, "horizon": 2, "num_iterations": 2, "num_elites": 2}
POLICY = {"minibatch_size": 8, "hidden_dims": (8,), "critic_hidden_dims": (8,), "epochs": 1}

# Learners with tiny networks, and whether they take several components.
LEARNERS = {
    "random": (Random, {}, True),
    "hppo": (HPPO, POLICY, True),
    "hppo autoregressive": (HPPO, POLICY | {"autoregressive": True}, True),
    "hppo mixed": (HPPO, POLICY | {"credit": "mixed"}, True),
    "pdqn": (PDQN, REPLAY, True),
    "pdqn single pass": (PDQN, REPLAY | {"multipass": False, "greedy_samples": 2}, True),
    "hsac": (HSAC, REPLAY, True),
    "hsac autoregressive": (HSAC, REPLAY | {"autoregressive": True}, True),
    "paddpg": (PADDPG, REPLAY, True),
    "iql": (IQL, REPLAY, True),
    "dlpa": (DLPA, PLANS | {"num_samples": 8, "batch_size": 4, "hidden_dims": (8,)}, True),
    "pets": (PETS, PLANS | {"num_samples": 4, "greedy_samples": 4, "max_sequences": 8, "batch_size": 4}, True),
    "hyar": (HyAR, REPLAY | {"codec_pretrain_updates": 1}, False),
    "td3_bc": (TD3BC, REPLAY, False),
    "qpamdp": (QPAMDP, {}, False),
}


PAIRS = [
    pytest.param(tree, name, marks=() if (place + number) % 10 == 0 else pytest.mark.slow)
    for place, tree in enumerate(TREES)
    for number, name in enumerate(LEARNERS)
]


@pytest.mark.parametrize(("tree", "name"), PAIRS)
def test_actions_lie_in_their_space_before_and_after_updates(tree, name):
    torch.manual_seed(0)
    learner_class, settings, takes_components = LEARNERS[name]
    # Many short rows: a step costs as much for eight copies as for one.
    env = GymnasiumEnv(8, make=lambda: Recorder(tree), max_steps=2, action_form=TREES[tree].form)
    specs = PAMDPSpecs.from_env(env)
    if not takes_components and not specs.components.is_single:
        with pytest.raises(SettingError, match="several components"):
            learner_class(specs, **settings)
        return
    if learner_class is HyAR and specs.num_parameters == 0:
        with pytest.raises(SettingError, match="no discrete action of the problem has one"):
            HyAR(specs)
        return
    learner = learner_class(specs, **settings)
    tracked = with_decisions(env)
    for _ in range(2):
        with set_exploration_type(ExplorationType.RANDOM):
            batch = tracked.rollout(2, learner.policy, break_when_any_done=False, auto_cast_to_device=False)
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        tracked.rollout(1, learner.policy, break_when_any_done=False)
    assert sum(len(copy.unwrapped.actions) for copy in env.envs) == 40
    assert all(np.isfinite(value.detach().numpy()).all() for value in learner.parameters())
