"""Crossing, the example whose best option changes within an episode, and learners that need no training."""

from __future__ import annotations

from typing import ClassVar

import torch
from crossing import Crossing, best_values
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner, Selector
from hpamdp.policies.high_level.meta_critic import MetaCritic
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.specs import PAMDPSpecs


class Toll(Crossing):
    """A crossing with a random reward at every step."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return super()._step(tensordict).set(keys.REWARD, torch.rand(*self.batch_size, 1))


def best_value(gamma: float, option_length: int) -> float:
    """Return the discounted return of the best choices of options from the start of the way."""
    return best_values(gamma, option_length)[0]


class WholeStep(TensorDictModuleBase):
    """Always take a whole step."""

    in_keys: ClassVar[list] = [keys.OBSERVATION]
    out_keys: ClassVar[list] = [keys.DISCRETE, keys.PARAMETERS]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        discrete = torch.zeros(td.batch_size, dtype=torch.long)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": torch.ones(*td.batch_size, 2)}})


class Stepper(Learner):
    """Take whole steps and learn nothing."""

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = WholeStep()


def steppers(selector: Selector, specs: PAMDPSpecs) -> HierarchicalAgent:
    """Return the agent that takes whole steps with the selector's options."""
    return HierarchicalAgent(selector, [Stepper(specs), Stepper(specs)], specs)


def earned(agent: HierarchicalAgent, gamma: float, option_length: int | None) -> float:
    """Return the discounted return of a greedy episode from the start of the way."""
    env = with_decisions(Crossing(1), option_length=option_length)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        rows = env.rollout(Crossing.max_steps, agent.policy)
    rewards = rows["next", keys.REWARD].flatten()
    return (gamma ** torch.arange(len(rewards)) * rewards).sum().item()


class Listener(Uniform):
    """Choose uniformly, and keep what there is to learn from."""

    def __init__(self, specs: PAMDPSpecs, *, gamma: float = 1.0) -> None:
        super().__init__(specs)
        self.gamma = gamma
        self.heard: list[TensorDictBase] = []

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        self.heard.append(decisions.clone())
        return {}


def make_meta_critic(**changes: object) -> MetaCritic:
    """Return a meta-critic that learns Crossing within some thousand decisions."""
    torch.manual_seed(0)
    options = dict(
        hidden_dims=[64], num_members=1, exploration="epsilon", epsilon_final=0.2, epsilon_decisions=2000,
        gamma=0.9, buffer_size=10_000, batch_size=64, updates_per_decision=0.1, warmup_decisions=200, lr=3e-3, tau=0.05,
    )  # fmt: skip
    return MetaCritic(PAMDPSpecs.from_env(Crossing()), **{**options, **changes})
