"""Corridor, a problem whose only reward is so far away that a random walk does not get there."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from toy_env import ToyEnv

from hpamdp import keys

BACK, FORTH, REST = 0, 1, 2


class Corridor(ToyEnv):
    """Go back or forth by a length in [0, 1], or rest. Only the end of the corridor is rewarded, with 1.

    A step costs `cost`, a rest nothing. So the best return without the end is 0, by resting. The observation is the
    place, in units of the corridor's length.

    Args:
        num_envs: environments of the batch.
        length: of the corridor; a step is at most 1.
        max_steps: steps of an episode.
        cost: of a step back or forth.
        device: where the tensors live.
    """

    parameter_dims = (1, 1, 0)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        length: float = 20.0,
        max_steps: int = 60,
        cost: float = 0.01,
        seed: int = 0,
        device: object = "cpu",
    ) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.length = length
        self.max_steps = max_steps
        self.cost = cost
        self.begin(0.0, 1.0, seed, observation=Bounded(0.0, 1.0, shape=(num_envs, 1)))

    def _set_seed(self, seed: int | None) -> None:
        self.place = torch.zeros(self.batch_size)
        self.steps = torch.zeros(self.batch_size, dtype=torch.long)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        self.place = torch.where(mask, 0.0, self.place)
        self.steps = torch.where(mask, 0, self.steps)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        discrete, parameters = tensordict[keys.DISCRETE], tensordict[keys.PARAMETERS]
        way = torch.where(discrete == FORTH, parameters[:, 1], -parameters[:, 0])
        was_there = self.place >= self.length
        place = torch.where((discrete == REST) | was_there, self.place, self.place + way)
        self.place = place.clamp(0.0, self.length)
        self.steps = self.steps + 1
        arrives = (self.place >= self.length) & ~was_there
        reward = torch.where(arrives, 1.0, torch.where(discrete == REST, 0.0, -self.cost))
        return self._read().set(keys.REWARD, reward.unsqueeze(-1))

    def _read(self) -> TensorDict:
        place: Tensor = (self.place / self.length).unsqueeze(-1)
        terminated = place >= 1.0
        truncated = (self.steps >= self.max_steps).unsqueeze(-1) & ~terminated
        return TensorDict({keys.OBSERVATION: place, **self.flags(terminated, truncated)}, self.batch_size)


def trained(learner, exploration=None, *, steps: int, num_envs: int = 16, steps_per_batch: int = 16, **corridor):
    """Train an agent of one learner and its exploration; return the agent and how many exploring episodes arrived."""
    from hpamdp.env.decisions import with_decisions
    from hpamdp.policies.agent import HierarchicalAgent

    env = with_decisions(Corridor(num_envs, **corridor), 1.0)
    agent = HierarchicalAgent(None, [learner], learner.specs, explorations=[] if exploration is None else [exploration])
    td, arrived = env.reset(), 0
    for _ in range(-(-steps // (num_envs * steps_per_batch))):
        with torch.no_grad():
            batch = env.rollout(
                steps_per_batch, agent.policy, break_when_any_done=False, auto_reset=False, tensordict=td
            )
        td = env.step_mdp(batch[:, -1])
        is_reset = batch[:, -1]["next", "done"].squeeze(-1)
        if is_reset.any():
            td = env.maybe_reset(td)
        arrived += int(batch["next", "terminated"].sum())
        agent.learn(batch)
    return agent, arrived


def greedy_return(agent, **corridor) -> float:
    """Return the return of a greedy episode."""
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    from hpamdp.env.decisions import with_decisions

    env = with_decisions(Corridor(1, **corridor), 1.0)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        rolled = env.rollout(200, agent.policy, break_when_any_done=True)
    return rolled["next", "reward"].sum().item()
